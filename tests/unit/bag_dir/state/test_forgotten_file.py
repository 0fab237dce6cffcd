from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ros2_memory.bag_dir.layout import FORGOTTEN_FILE
from ros2_memory.bag_dir.state_files import (
    FORGOTTEN,
    Forgetting,
    ForgottenBag,
    read_forgettings,
)

if TYPE_CHECKING:
    from pathlib import Path

BAGS = Forgetting(1, 9, bags=(ForgottenBag("run", "run_0.mcap", 1), ForgottenBag("r}", "]}", 4)))
TOPICS = Forgetting(2, 3, topics=("/camera", "/odd]}"))


def test_what_was_appended_is_read_in_order_and_once(tmp_path: Path) -> None:
    assert read_forgettings(tmp_path) == []
    FORGOTTEN.append(tmp_path, [BAGS, TOPICS])
    FORGOTTEN.append(tmp_path, [BAGS])
    assert read_forgettings(tmp_path) == [BAGS, TOPICS]


def test_a_line_that_a_crash_cut_anywhere_hides_no_other(tmp_path: Path) -> None:
    file = tmp_path / FORGOTTEN_FILE
    FORGOTTEN.append(tmp_path, [TOPICS])
    whole = file.read_bytes()
    FORGOTTEN.append(tmp_path, [BAGS])
    both = file.read_bytes()
    for length in range(len(whole), len(both) - 1):
        file.write_bytes(both[:length])
        try:
            assert read_forgettings(tmp_path) == [TOPICS]
        except ValueError:
            # Within a name that looks like the end of a line: nothing is shipped then.
            assert both[:length].endswith(b"]}")
            continue
        FORGOTTEN.append(tmp_path, [BAGS])
        assert read_forgettings(tmp_path) == [TOPICS, BAGS]


@pytest.mark.parametrize("at", ["first", "last"])
def test_a_damaged_line_is_an_error_wherever_it_is(tmp_path: Path, at: str) -> None:
    FORGOTTEN.append(tmp_path, [BAGS, TOPICS])
    file = tmp_path / FORGOTTEN_FILE
    lines = file.read_text().splitlines()
    number = 0 if at == "first" else 1
    lines[number] = lines[number].replace('"start": ', '"start" ')
    file.write_text("".join(f"{each}\n" for each in lines))
    with pytest.raises(ValueError, match=f"line {number + 1}: "):
        read_forgettings(tmp_path)
