"""`cocoro topics`: the table of what travels, as a table, as data, and as the page of the documentation."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterable
from importlib import resources
from typing import Annotated, Any, NamedTuple

import typer

from apps.cli.options import JsonOption
from apps.cli.terminal import Column
from apps.cli.terminal import table as fitted_table
from cocoro.bus.base import Qos
from cocoro.component import Component
from cocoro.installed import all_requests, all_topics
from cocoro.messages.actions import ACTIONS
from cocoro.topics import REQUESTS, TOPICS, Request, Topic
from deploy.processes import COMPONENTS, publishers, readers

QOS = {
    Qos.FRAME: "newest wins; shared memory, lowest priority",
    Qos.STATE: "newest wins",
    Qos.COMMAND: "newest wins; sent immediately, at real-time priority; expires",
    Qos.EVENT: "reliable, in order",
}


HEADS = ("topic", "type", "rate", "max age", "qos", "publisher", "recorded")
COLUMNS = tuple(Column(head, rank) for head, rank in zip(HEADS, (0, 1, 0, 2, 3, 0, 4), strict=True))
REQUEST_COLUMNS = ("request", "question", "answer", Column("server", 2), Column("time-out", 1))

app = typer.Typer()


@app.command()
def topics(
    as_page: Annotated[bool, typer.Option("--markdown", help="The whole page of the documentation.")] = False,
    json: JsonOption = False,
) -> None:
    """List the topics and requests of all components: type, rate, age, quality of service, publisher."""
    print(markdown() if as_page else as_json() if json else table(), end="")


def table() -> str:
    """The topics and requests of all installed components, as text."""
    topics = fitted_table(COLUMNS, [_row(topic) for topic in all_topics()])
    return f"{topics}\n{fitted_table(REQUEST_COLUMNS, [_request_row(request) for request in all_requests()])}"


def as_json() -> str:
    """The topics as JSON, one object each."""
    rows: list[dict[str, Any]] = [
        {
            "topic": topic.name,
            "type": topic.type.__name__,
            "rate_hz": topic.rate_hz,
            "max_age_s": topic.max_age_s,
            "qos": topic.qos.value,
            "publisher": ", ".join(publishers(topic)),
            "readers": list(readers(topic)),
            "recorded": topic.recorded,
            "max_bytes": topic.max_bytes,
            "doc": topic.doc,
        }
        for topic in all_topics()
    ]
    return json.dumps(rows) + "\n"


def _row(topic: Topic[Any], among: Iterable[Component] | None = None) -> tuple[str, ...]:
    rate = "on change" if topic.rate_hz is None else f"{topic.rate_hz:g} Hz"
    age, recorded = f"{topic.max_age_s:g} s", "yes" if topic.recorded else "no"
    return topic.name, topic.type.__name__, rate, age, topic.qos.value, ", ".join(publishers(topic, among)), recorded


def _request_row(request: Request[Any, Any]) -> tuple[str, ...]:
    question, answer = request.request.__name__, request.reply.__name__
    return request.name, question, answer, request.server, f"{request.timeout_s:g} s"


# --- the page of the documentation ----------------------------------------------------------------


def markdown() -> str:
    """The text of docs/topics.md: the project's own topics, whatever else is installed."""
    types = _types()
    mentioned = [*(topic.type.__name__ for topic in TOPICS)]
    mentioned += [name for request in REQUESTS for name in (request.request.__name__, request.reply.__name__)]
    parts = [
        "# Topics\n",
        "Made by `cocoro topics --markdown` from `cocoro/topics.py`, `cocoro/messages/` and the declarations of the\n"
        "components (`services/*/component.py`, `sim/`); change those. A recorder reads everything that is recorded.\n",
        "A key is `<robot>/<topic>`. A payload is one MessagePack map with the fields below, in the SI units that\n"
        "their names give. A reader ignores fields that it does not know. It drops messages that are malformed,\n"
        "wrongly typed, too large or out of order, and counts them in its health.\n",
        "## Topics of messages\n",
        _markdown_table((*HEADS, "readers"), (_row_with_readers(topic) for topic in TOPICS)),
        *(f"- `{topic.name}`: {topic.doc}" for topic in TOPICS),
        "\nQuality of service: "
        + "; ".join(f"**{qos.value}**: {text.replace(';', ',')}" for qos, text in QOS.items())
        + ".\n",
        "## Requests\n",
        _markdown_table(("request", "question", "answer", "server", "time-out"), map(_request_row, REQUESTS)),
        *(f"- `{request.name}`: {request.doc}" for request in REQUESTS),
        "\n## Types\n",
        *(_type_section(types[name]) for name in _with_parts(dict.fromkeys(mentioned), types)),
        "## Actions\n",
        "The field `action` of an `Intent` is a map: the name of an action in `action`, and its fields.\n",
        *(_type_section(types[kind.__name__]._replace(name=name)) for name, kind in ACTIONS.own.items()),
    ]
    return "\n".join(parts).rstrip() + "\n"


def _row_with_readers(topic: Topic[Any]) -> tuple[str, ...]:
    return *_row(topic, COMPONENTS), ", ".join(readers(topic, COMPONENTS))


class _Field(NamedTuple):
    name: str
    type: str
    default: str
    doc: str


class _Type(NamedTuple):
    name: str
    bases: tuple[str, ...]
    doc: str
    fields: tuple[_Field, ...]


def _types() -> dict[str, _Type]:
    """The classes of `cocoro.messages` as they are written: a field's text is the string that follows it."""
    files = [file for file in resources.files("cocoro.messages").iterdir() if file.name.endswith(".py")]
    modules = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
    return {node.name: _type(node) for module in modules for node in module.body if isinstance(node, ast.ClassDef)}


def _type(node: ast.ClassDef) -> _Type:
    fields: list[_Field] = []
    for item in node.body:
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name):
            default = "" if item.value is None else ast.unparse(item.value)
            fields.append(_Field(item.target.id, ast.unparse(item.annotation), default, ""))
        elif isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) and fields:
            fields[-1] = fields[-1]._replace(doc=" ".join(str(item.value.value).split()))
    bases = tuple(base.id for base in node.bases if isinstance(base, ast.Name))
    return _Type(node.name, bases, " ".join((ast.get_docstring(node) or "").split()), tuple(fields))


def _with_parts(names: Iterable[str], types: dict[str, _Type]) -> list[str]:
    """The named types, and behind each those that its fields are made of; what all messages share comes first."""
    found = ["Message"]

    def add(name: str) -> None:
        if name in found:
            return
        found.append(name)
        for field in types[name].fields:
            for word in ast.walk(ast.parse(field.type, mode="eval")):
                if isinstance(word, ast.Name) and word.id in types:
                    add(word.id)

    for name in names:
        add(name)
    return found


def _type_section(kind: _Type) -> str:
    also = " With the fields of `Message`." if "Message" in kind.bases else ""
    rows = [(f"`{field.name}`", f"`{field.type}`", _code(field.default), field.doc) for field in kind.fields]
    table = _markdown_table(("field", "type", "default", ""), rows) if rows else ""
    parts = (f"### {kind.name}", f"{kind.doc}{also}".strip(), table.rstrip("\n"))
    return "\n\n".join(part for part in parts if part) + "\n"


def _code(text: str) -> str:
    return f"`{text}`" if text else ""


def _markdown_table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    lines = [tuple(heads)]
    lines.append(("---",) * len(lines[0]))
    lines += [tuple(cell.replace("|", "\\|") for cell in row) for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
