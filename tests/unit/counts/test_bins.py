from datetime import datetime
from pathlib import Path

from tests.support.bags import boolean, odom, write_mcap
from tests.support.memories import asked, memory_of, with_store
from tests.support.tables import table

S = 10**9
BEGIN = 1_784_059_400 * S


def test_times_in_which_nothing_was_recorded_have_no_rows(tmp_path: Path) -> None:
    noon = round(datetime(2026, 3, 2, 12, 30).astimezone().timestamp())
    for begin in (noon, noon + 5 * 3600, noon + 3 * 86_400):
        at = begin * S
        write_mcap(tmp_path / f"{begin}.mcap", [odom(at + n * S, n, 0.0) for n in range(20)])
    memory = memory_of(tmp_path)

    def rows(by: str) -> tuple[list[str], list[str]]:
        span = {"start": noon, "end": noon + 3 * 86_400 + 60}
        reply = asked(memory, tmp_path, "trajectory_summary", by=by, **span)
        notes = [each for each in reply.get("notes", ()) if each.startswith("no rows")]
        return [each[0] for each in reply["rows"]], notes

    start = "no rows for times in which nothing was recorded: "
    hours, notes = rows("hour")
    assert hours == ["12:00", "17:00"]
    assert notes == [f"{start}00:00 to 11:00, 13:00 to 16:00, 18:00 to 23:00"]
    days, notes = rows("day")
    assert days == ["2026-03-02", "2026-03-05"]
    assert notes == [f"{start}2026-03-03 to 2026-03-04"]
    weekdays, notes = rows("weekday")
    assert weekdays == ["Monday", "Thursday"]
    assert notes == [f"{start}Tuesday to Wednesday"]


def test_where_nothing_was_recorded_a_boolean_does_not_last(tmp_path: Path) -> None:
    for name, begin in (("one", 0), ("two", 20_000)):
        messages = [
            boolean(BEGIN + (begin + at) * S, at >= 50, topic="/is_docked") for at in range(100)
        ]
        # The last message before the time without any is all that its bag has.
        for number, split in enumerate((messages[:-1], messages[-1:])):
            write_mcap(tmp_path / name / f"{name}_{number}.mcap", split)
    memory = memory_of(tmp_path)
    asks = {"topic": "/is_docked", "condition_type": "equals", "by": "day"}
    for each in (memory, with_store(memory, tmp_path)):
        docked = table(asked(each, tmp_path, "find_matches", **asks, value=True))["all"]
        assert (docked["count"], docked["seconds"]) == (2, 2 * 49)
        reply = asked(each, tmp_path, "find_matches", **asks, value="false")
        off = table(reply)["all"]
        # Twice it was off the dock from the beginning on: nobody saw it leave.
        assert (off["count"], off["seconds"], off["recorded_s"]) == (0, 2 * 50, 2 * 99)
        assert "usual_first" not in reply


def test_the_first_of_a_day_is_not_known_where_the_window_begins_after_others(
    tmp_path: Path,
) -> None:
    midnight = round(datetime(2026, 3, 2).astimezone().timestamp())
    for day, hour in ((0, 8), (0, 17), (1, 9), (2, 8)):
        begin = midnight + day * 86_400 + hour * 3600
        messages = [boolean((begin + at) * S, at >= 10, topic="/is_driving") for at in range(20)]
        write_mcap(tmp_path / f"{begin}.mcap", messages)
    memory = memory_of(tmp_path)
    asks = {"topic": "/is_driving", "condition_type": "equals", "value": True, "by": "day"}

    def usual_first(start_h: float) -> tuple[str, str, int]:
        span = {"start": midnight + start_h * 3600, "end": midnight + 3 * 86_400}
        usual = asked(memory, tmp_path, "find_matches", **asks, **span)["usual_first"]
        return usual["earliest"], usual["latest"], usual["days"]

    assert usual_first(0) == usual_first(7) == usual_first(8) == ("08:00:10", "09:00:10", 3)
    assert usual_first(15) == ("08:00:10", "09:00:10", 2)
