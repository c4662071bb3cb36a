"""`cocoro doctor`, and the files that messages to users name."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from apps.cli import doctor
from apps.cli.main import main

ROOT = Path(__file__).parent.parent
PACKAGES = ("apps", "deploy", "services", "sim", "cocoro")
OF_THE_CHECKOUT = re.compile(r"\b(?:docs|deploy|bench|tests)/|\bREADME|\.md\b")
"""Files that an installation by pip lacks, or has at a place of its own."""
WRITTEN = {"report.md", "WHAT-IS-MISSING.md"}
"""Files that the program itself writes."""


def messages(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """The texts of a module, without its docstrings, except those of commands, which are their --help."""
    silent = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            command = any("command" in ast.unparse(each) for each in getattr(node, "decorator_list", []))
            silent |= {id(child.value) for child in node.body if isinstance(child, ast.Expr) and not command}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in silent:
            yield node.lineno, node.value


def test_no_message_names_a_file_that_an_installation_by_pip_lacks() -> None:
    wrong = [
        f"{file.relative_to(ROOT)}:{line}: {text}"
        for package in PACKAGES
        for file in sorted((ROOT / package).rglob("*.py"))
        for line, text in messages(ast.parse(file.read_text(encoding="utf-8")))
        if OF_THE_CHECKOUT.search(text) and text not in WRITTEN
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.process
def test_the_files_that_doctor_tells_to_install_are_there(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "RULES", tmp_path / "99-cocoro.rules")  # not installed
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setattr("resource.getrlimit", lambda _which: (0, 0))
    assert main(["doctor", "robot", "--json"]) == 1
    texts = {check["name"]: check["text"] for check in json.loads(capsys.readouterr().out)}
    named = [
        re.search(r"(/\S+/99-cocoro\.rules) ", texts["udev rules"]),
        re.search(r"\((/.+)\)", texts["real-time priority"]),
    ]
    for found in named:
        assert found is not None
        assert Path(found[1]).is_file()
