from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.layout import MOMENT_FILE, bag_kind
from ros2_memory.bag_dir.moment_file import (
    SavedMoment,
    SaveRequest,
    fault_of_label,
    folder_name,
    make_moment_folder,
    read_saved_moment,
    stored_moments_in,
    write_saved_moment,
)

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
T0 = 1_795_150_800 * S  # 2026-11-20T05:00:00Z
NUMBER = "0123456789abcdef" * 2


def request(label: str = "charger found", number: str = NUMBER) -> SaveRequest:
    return SaveRequest(number, label, T0 - 30 * S, T0, T0)


class TestLabels:
    @pytest.mark.parametrize(
        "label", ["a", "Küche, 2. Stock", "充電 /../ etc", "x" * 120, "it's 🙂"]
    )
    def test_what_people_write_is_one(self, label: str) -> None:
        assert fault_of_label(label) is None

    @pytest.mark.parametrize(
        "label",
        ["", "  ", "x" * 121, "two\nlines", "tab\t", "nul\0", "\u202eedoc", "\ud800", "\u2028"],
    )
    def test_what_cannot_be_seen_or_is_too_long_is_none(self, label: str) -> None:
        assert fault_of_label(label)

    @given(st.text(max_size=130))
    def test_any_of_them_names_a_folder_that_is_safe(self, label: str) -> None:
        name = folder_name(request(label))
        assert re.fullmatch(r"20261120T050000Z-[a-z0-9]+(-[a-z0-9]+)*", name)
        assert bag_kind(name) is None
        assert len(name) < 64


class TestFolders:
    def test_two_of_one_label_and_second_have_their_own(self, tmp_path: Path) -> None:
        names = [make_moment_folder(tmp_path, request()).name for _ in range(3)]
        assert names == [f"20261120T050000Z-charger-found{end}" for end in ("", "_2", "_3")]


class TestMomentFiles:
    @given(
        st.text(min_size=1, max_size=120).filter(lambda text: not fault_of_label(text)),
        st.booleans(),
        st.lists(st.text(st.characters(exclude_categories=["Cs"])), max_size=3),
    )
    def test_what_is_written_is_read(
        self,
        tmp_path_factory: pytest.TempPathFactory,
        label: str,
        pending: bool,
        missing: list[str],
    ) -> None:
        folder = tmp_path_factory.mktemp("moment")
        moment = SavedMoment(request(label), pending, tuple(missing))
        write_saved_moment(folder, moment)
        assert read_saved_moment(folder) == moment
        complete = json.loads((folder / MOMENT_FILE).read_text())["complete"]
        assert complete == (not pending and not missing)

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "[]",
            "[" * 100_000,
            '{"format": 2}',
            '{"format": 1}',
            json.dumps(
                {
                    "format": 1,
                    "request": NUMBER,
                    "label": "a",
                    "start_ns": 5,
                    "end_ns": 4,
                    "requested_ns": 5,
                    "pending": False,
                    "missing": [],
                }
            ),
        ],
    )
    def test_what_says_something_else_is_no_moment(self, tmp_path: Path, text: str) -> None:
        folder = make_moment_folder(tmp_path, request())
        (folder / MOMENT_FILE).write_text(text)
        assert read_saved_moment(folder) is None
        assert list(stored_moments_in(tmp_path)) == []
