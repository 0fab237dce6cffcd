"""`topics.yaml`: what it may list, and the regular expression that comes of it."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import ConfigError
from ros2_memory.recorder.process.topics import TopicSelection, TopicsFile, load_topics

SHIPPED = Path(__file__).resolve().parents[4] / "config/topics.yaml"
NAMES = st.lists(
    st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,8}){1,3}", fullmatch=True), min_size=1, max_size=6
)


def listed(folder: Path, text: str) -> Path:
    path = folder / "topics.yaml"
    path.write_text(text)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load_topics(path)
    return str(caught.value)


def test_the_shipped_list_is_that_of_the_specification() -> None:
    assert load_topics(SHIPPED).entries == (
        "/odom",
        "/tf",
        "/tf_static",
        "/cmd_vel",
        "/vision/scene/scene_description",
        "/vision/scene/scene_objects",
        "/vision/find_object/detections_meta",
    )


@given(NAMES, NAMES)
def test_exactly_the_listed_names_match(wanted: list[str], others: list[str]) -> None:
    topics = TopicSelection(tuple(wanted))
    assert all(topics.matches(name) for name in wanted)
    assert [name for name in others if topics.matches(name) != (name in wanted)] == []
    assert "\\" not in topics.regex  # dialects of regular expressions differ in what needs one


def test_events_of_a_service_are_selected_by_the_name_of_the_service_too() -> None:
    # `ros2 bag record` of Jazzy compares that name with the pattern.
    topics = TopicSelection(("/odom", "/set_mode/_service_event"))
    assert topics.services == ("/set_mode/_service_event",)
    assert topics.matches("/set_mode")
    assert topics.matches("/set_mode/_service_event")
    assert not topics.matches("/set_mode/_service_event_2")
    assert topics.hidden


@pytest.mark.parametrize(
    "entry",
    ["odom", "/odom/", "//odom", "/", "/1st", "/a b", "/a|/.*", "/ä", "/~", "/a/**", "/x" * 200, 3],
)
def test_an_invalid_name_is_refused_with_file_and_entry(tmp_path: Path, entry: object) -> None:
    path = listed(tmp_path, yaml.safe_dump({"topics": ["/odom", entry]}))
    assert refusal(path).startswith(f"{path}: {entry!r} cannot be recorded: it must be a fully ")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        *(
            (text, "the key topics")
            for text in (
                "topics: []",
                "topics:\n  # - /odom\n",
                "topics: /odom",
                "topics: [/odom]\nexclude: /odom",
                "- /odom",
                "",
                "topics: [/odom]\ntopic: [/tf]",
            )
        ),
        ("topics: [/odom", "it is not YAML"),
        ("topics: [2026-02-30]", "it is not YAML: day is out of range for month"),
        ("topics: [0b_]", "it is not YAML"),
        (f"topics: {'[' * 1000}", "it is not YAML: maximum recursion depth"),
    ],
)
def test_what_is_no_list_of_topics_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = listed(tmp_path, text)
    message = refusal(path)
    assert message.startswith(f"{path}: ")
    assert reason in message


def test_a_missing_list_is_refused_with_its_key(tmp_path: Path) -> None:
    assert "recording.topics_file" in refusal(tmp_path / "nowhere.yaml")


def test_more_topics_than_a_pattern_can_hold_are_refused(tmp_path: Path) -> None:
    lines = "\n".join(f"- /{'t' * 200}_{number}" for number in range(400))
    assert "use globs" in refusal(listed(tmp_path, f"topics:\n{lines}\n"))


def test_what_is_excluded_is_not_selected_by_a_glob(tmp_path: Path) -> None:
    lists = "topics: [/vision/*/meta, /odom, /bump]\nexclude: [/vision/debug_*/meta, /bump]"
    topics = load_topics(listed(tmp_path, lists))
    assert topics.exact == ("/odom",)
    assert all(map(topics.matches, ("/vision/scene/meta", "/odom")))
    assert not any(
        map(
            topics.matches,
            ("/vision/debug_1/meta", "/vision/meta", "/vision/a/b/meta", "/vision/a/me"),
        )
    )
    assert "fully qualified" in refusal(listed(tmp_path, "topics: [/odom]\nexclude: [odom]"))


def test_a_changed_list_must_have_what_rules_and_settings_need(tmp_path: Path) -> None:
    path = listed(tmp_path, "topics: [/odom, /privacy]\n")
    topics = TopicsFile(path, {"/privacy": "the rule 'private'"})
    topics.load()
    path.write_text("topics: [/odom]\n")
    assert [topics.look() for _ in range(3)] == [False] * 3
    assert "does not list /privacy, which the rule 'private' needs" in str(topics.refused)
    assert topics.selection.matches("/privacy")
    path.write_text("topics: [/tf, /priv*]\n")
    assert [topics.look() for _ in range(3)] == [False, True, False]
    assert not topics.refused
    assert topics.selection.entries == ("/tf", "/priv*")
    path.unlink()
    assert [topics.look() for _ in range(3)] == [False] * 3
    assert "cannot be read" in str(topics.refused)
