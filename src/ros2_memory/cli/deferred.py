"""Commands that are imported when they are asked for: to list them costs nothing of theirs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

import typer
from typer.core import TyperCommand
from typer.main import get_group

from ros2_memory.cli.exits import epilog

if TYPE_CHECKING:
    from typer._click import Command, Context  # of which Typer has no public names


class Deferred(TyperCommand):
    """Stands in the list of commands for one that is not imported yet.

    Args:
        name: what people type.
        place: the full path of its function, or of the Typer application of a group.
        purpose: what the list says of it.
    """

    def __init__(self, name: str, place: str, purpose: str) -> None:
        super().__init__(name, short_help=purpose)
        self._name = name
        self._place = place

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: Context | None = None,
        **extra: object,
    ) -> Context:
        """The context of the command itself, which is what runs, completes and shows its help."""
        return self._loaded().make_context(info_name, args, parent, **extra)

    def _loaded(self) -> Command:
        module, _, attribute = self._place.rpartition(".")
        found: object = getattr(import_module(module), attribute)
        holder = typer.Typer(add_completion=False, rich_markup_mode=None)
        if isinstance(found, typer.Typer):
            holder.add_typer(found, name=self._name, epilog=epilog(self._name))
        elif callable(found):
            holder.command(self._name, epilog=epilog(self._name))(found)
        return get_group(holder).commands[self._name]
