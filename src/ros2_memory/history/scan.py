"""Scans of topics within one call: what `columns.scan` yields, under the call's deadline."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.columns.scan import Asked, Scanner

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from ros2_memory.columns.table import Table
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import BagFile, TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View


def scan(
    view: View,
    topic: str,
    window: TimeWindow,
    *,
    newest_first: bool = False,
    reached: Callable[[Ns], None] = lambda _: None,
) -> Iterator[Rows]:
    """Yields the rows of a topic in a window; see `Scanner.rows`.

    What cannot be read is noted. `reached` is called before each table with a log time that what
    is left does not lie behind (with `newest_first`: is not later than).

    Raises:
        QueryTimeoutError: while it is iterated, when the deadline has passed.
    """
    scanner = view.memory.columns or Scanner(None, view.memory.index.bag_dir)

    def decode(bag: BagFile, topic: str, hashed: bool) -> Iterable[Table]:
        return view.bags.tables(bag, topic, hashed=hashed)

    def check(at: Ns) -> None:
        reached(at)
        view.bags.check_deadline()

    asked = Asked(
        topic,
        window,
        view.snapshot.timeline,
        decode,
        shared=view.stream.duplicate_spans(topic, window),
        relatches=view.stream.may_be_relatched([topic]),
        check=check,
    )
    return scanner.rows(asked, newest_first=newest_first)
