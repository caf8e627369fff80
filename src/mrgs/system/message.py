"""A sentence that remembers its values, so that it can be said in another language."""

from __future__ import annotations


class Message(str):
    """A text with values filled in; anything that reads texts can read it.

    Args:
        template: English, with values as ``{name}``.
        values: in place of them, formatted.

    Attributes:
        template: as given.
        values: as given.
    """

    template: str
    values: dict[str, str]

    def __new__(cls, template: str, **values: str) -> Message:  # noqa: D102
        message = super().__new__(cls, template.format(**values) if values else template)
        message.template, message.values = template, values
        return message
