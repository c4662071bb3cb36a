"""Open families of types that travel by their tag, such as tasks and actions: the project's own, and third parties'."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Generic, TypeVar

import msgspec

from cocoro.errors import choice_of, field_text

T = TypeVar("T", bound="Tagged")


class Tagged(msgspec.Struct, frozen=True):
    """Base of the types of a family: frozen structs whose maps on the wire hold their tags."""

    @classmethod
    def tag(cls) -> str:
        return str(cls.__struct_config__.tag)

    @property
    def name(self) -> str:
        return self.tag()

    @property
    def target(self) -> str:
        """The label of the object that the task or action concerns; '' for none."""
        return str(getattr(self, "label", ""))


class Registry(Generic[T]):
    """The types of one family by tag: the project's own, and those that third parties add."""

    def __init__(self, word: str, own: Iterable[type[T]], others: Callable[[], Iterable[type[T]]]) -> None:
        """`word` names a member in messages ("task"). `others` is called when a name is not one of the own types, and
        when all are listed."""
        self._word = word
        self._own = {kind.tag(): kind for kind in own}
        self._others = others

    @property
    def own(self) -> Mapping[str, type[T]]:
        return self._own

    def all(self) -> dict[str, type[T]]:
        """Own types first. A third party's type with the name of an own one is left out."""
        return {kind.tag(): kind for kind in self._others()} | self._own

    def kind(self, name: object) -> type[T]:
        """The type of a name. Raises ValueError, which lists the known names."""
        text = name if isinstance(name, str) else ""
        found = self._own.get(text) or self.all().get(text)
        if found is None:
            raise ValueError(f"unknown {self._word} {name!r}; {choice_of(name, self.all())}")
        return found

    def read(self, data: object) -> T:
        """A member from the map that it travels as; a member stays as it is. Raises ValueError, which lists the known
        names for an unknown one, and names the field that is wrong."""
        if isinstance(data, Tagged):
            return data  # type: ignore[return-value] # its maker chose the family
        if not isinstance(data, Mapping):
            raise ValueError(f"{self._word}: a map is expected, not {type(data).__name__}")
        kind = self.kind(data.get(self._word))
        try:
            return msgspec.convert(data, kind)
        except msgspec.ValidationError as error:
            raise ValueError(f"{kind.tag()}: {field_text(error, kind)}") from error
