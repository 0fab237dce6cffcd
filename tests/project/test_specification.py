"""docs/reference/specification.md names what exists, for every section of the specification."""

from __future__ import annotations

import re

import yaml

from tests.support.memories import ROOT

PAGE = (ROOT / "docs/reference/specification.md").read_text(encoding="utf-8")
CONFIG = ROOT / "config/config.yaml"
SECTIONS = ["1", "2", "3", "4", "5", "6", "7", "8", "9", "A"]
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if re.match(r"\| [1-9A] ", line)
]
NAMED_KEYS = {
    "recording.bag_dir": "data/bags",
    "recording.split_duration_s": 10,
    "recording.clear_on_startup": False,
    "recording.topics_file": "config/topics.yaml",
    "data.max_array_length": 50,
    "data.position_tolerance_m": 0.5,
    "data.time_tolerance_s": 0.1,
    "reader.index_refresh_s": 5,
    "reader.custom_msg_paths": [],
    "retention.max_total_gb": 5.0,
    "retention.max_age_h": 168,
}
"""The keys of section 7, with their defaults there."""


def test_the_table_has_every_section_in_order() -> None:
    assert list(dict.fromkeys(row[0].split()[0] for row in ROWS)) == SECTIONS
    assert {len(row) for row in ROWS} == {4}


def test_each_row_says_where_it_is_and_what_tests_it() -> None:
    for section, code, tests, _ in ROWS:
        assert "`" in code or code == "the rows above", section
        assert "`tests/" in tests, section


def test_the_configuration_marks_the_keys_of_the_specification_with_its_defaults() -> None:
    marked, section = {}, ""
    values = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))
    for line in CONFIG.read_text(encoding="utf-8").splitlines():
        if found := re.fullmatch(r"(\w+):", line):
            section = found[1]
        elif found := re.fullmatch(r"  (\w+): .*  # \* .*", line):
            marked[f"{section}.{found[1]}"] = values[section][found[1]]
    assert marked == NAMED_KEYS
