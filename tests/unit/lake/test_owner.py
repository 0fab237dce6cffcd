"""A lake belongs to one state directory, whatever becomes of the process that writes it."""

import json
from pathlib import Path

import pytest

from ros2_memory.core.errors import LakeError
from ros2_memory.lake.warehouse import LakeLocation


def hub(folder: Path, name: str) -> LakeLocation:
    state_dir = folder / name
    state_dir.mkdir(exist_ok=True)
    return LakeLocation((folder / "lake").as_uri(), state_dir)


def owner_file(folder: Path) -> Path:
    return folder / "lake" / "ros2_memory" / "writer.json"


def test_the_first_hub_keeps_the_lake_and_another_is_refused_until_it_is_given_up(
    tmp_path: Path,
) -> None:
    hub(tmp_path, "one").claim()
    for _ in range(2):
        with pytest.raises(
            LakeError, match=rf"another writer, with lake\.state_dir={tmp_path}/one"
        ):
            hub(tmp_path, "other").claim()
        hub(tmp_path, "one").claim()  # also after it was killed
    # The file of an older version keeps others out, too.
    own = json.loads(owner_file(tmp_path).read_text())
    owner_file(tmp_path).write_text(json.dumps({"id": own["id"], "pid": 1, "until": 0}))
    hub(tmp_path, "one").claim()
    with pytest.raises(LakeError, match="another writer"):
        hub(tmp_path, "other").claim()
    owner_file(tmp_path).unlink()
    hub(tmp_path, "other").claim()
    # What the first would commit now is refused.
    with pytest.raises(LakeError, match="another writer"):
        hub(tmp_path, "one").claim()


@pytest.mark.parametrize("text", ["", "{", "[]", json.dumps({"id": 5})])
def test_a_damaged_file_keeps_nobody_out(tmp_path: Path, text: str) -> None:
    owner_file(tmp_path).parent.mkdir(parents=True)
    owner_file(tmp_path).write_text(text)
    hub(tmp_path, "one").claim()
    with pytest.raises(LakeError, match="another writer"):
        hub(tmp_path, "other").claim()
