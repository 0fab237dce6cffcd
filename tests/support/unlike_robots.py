"""Five robots that have little in common, a minute each."""

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np

from tests.support.bags import (
    Msg,
    battery,
    detections,
    header,
    make,
    odom,
    point,
    text,
    write_splits,
)
from tests.support.moving_map import BEGIN, S, moving_map
from tests.support.noisy_robots import write_noisy_robot

LENGTH_S = 60
YEAR_NS = 365 * 86_400 * S
SPLIT_S = 12


def _write(bag_dir: Path, messages: list[Msg]) -> Path:
    write_splits(bag_dir, messages, SPLIT_S, dated=True)
    return bag_dir


def damaged(bag_dir: Path) -> Path:
    """Of its bags one lost its end, and one has a flipped byte in its middle."""
    write_noisy_robot("damaged", bag_dir)
    for number, wrong in zip(DAMAGED, (_cut, _flipped), strict=True):
        path = bag_dir / "rec" / f"rec_{number}.mcap"
        times = path.stat()
        path.write_bytes(wrong(path.read_bytes()))
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    return bag_dir


def _cut(data: bytes) -> bytes:
    return data[: len(data) * 2 // 3]


def _flipped(data: bytes) -> bytes:
    middle = len(data) // 3
    return data[:middle] + bytes([data[middle] ^ 0x55]) + data[middle + 1 :]


def underwater(bag_dir: Path) -> Path:
    """It dives: its poses have a depth and a pitch, and are of a topic that is no odometry."""
    messages: list[Msg] = []
    for step in range(5 * LENGTH_S):
        at = BEGIN + step * S // 5
        depth, pitch = -step / 20, step / 400
        orientation = make(
            "geometry_msgs/msg/Quaternion", x=0.0, y=np.sin(pitch / 2), z=0.0, w=np.cos(pitch / 2)
        )
        pose = make(
            "geometry_msgs/msg/Pose", position=point(step / 10, 0.0, depth), orientation=orientation
        )
        body = make("geometry_msgs/msg/PoseStamped", header=header(at, "world_ned"), pose=pose)
        messages.append(Msg("/auv/pose", "geometry_msgs/msg/PoseStamped", at, body, at))
        pressure = make(
            "sensor_msgs/msg/FluidPressure",
            header=header(at, "auv"),
            fluid_pressure=101_325.0 - 9_810 * depth,
            variance=0.0,
        )
        messages.append(Msg("/auv/pressure", "sensor_msgs/msg/FluidPressure", at, pressure, at))
        if step % 50 == 25:
            messages.append(detections(at, ["wreck"], topic="/vision/sonar/objects"))
    return _write(bag_dir, messages)


def a_year_behind(bag_dir: Path) -> Path:
    """Its clock, or its use, is of a year ago; all else is as of others."""
    _, messages = moving_map(Random("behind"), LENGTH_S, noise_m=0.01)
    return _write(bag_dir, [replace(each, log_time=each.log_time - YEAR_NS) for each in messages])


def without_transforms(bag_dir: Path) -> Path:
    """It drives, sees and speaks, and no transform says where anything is."""
    messages: list[Msg] = []
    for step in range(5 * LENGTH_S):
        at = BEGIN + step * S // 5
        messages.append(odom(at, step / 25, 0.3, vx=0.2))
        if step % 25 == 0:
            messages += [detections(at, ["mug"]), text(at + 1, f"step {step}", "/speech")]
            messages.append(battery(at + 2, 1 - step / 1000))
    return _write(bag_dir, messages)


def two_cameras(bag_dir: Path) -> Path:
    """Two cameras with a detector each, and images, of which a lake has the times alone."""
    draw = Random(5)
    _, messages = moving_map(draw, LENGTH_S, noise_m=0.01)
    for second in range(LENGTH_S):
        at = BEGIN + second * S
        for camera, label in (("left", "fork"), ("right", "knife")):
            image = draw.randbytes(5_000)
            messages.append(Msg(f"/{camera}/image", "sensor_msgs/msg/Image", at + 2, image, at))
            if second % 4 == 0:
                seen = detections(
                    at + 5, [label], topic=f"/vision/{camera}/objects", at=(1.0, 0.5, 0.2)
                )
                messages.append(seen)
    return _write(bag_dir, messages)


DAMAGED = (1, 3)
"""The numbers of the damaged robot's bags that are."""
SEEN = {
    "behind": "cup",
    "damaged": "mug",
    "diver": "wreck",
    "lost": "mug",
    "twin": "knife",
}
ROBOTS: Mapping[str, Callable[[Path], Path]] = {
    "behind": a_year_behind,
    "damaged": damaged,
    "diver": underwater,
    "lost": without_transforms,
    "twin": two_cameras,
}
