"""Robots as they are: noisy poses, a map that moves, a detector that errs, and many changes."""

from pathlib import Path
from random import Random

from tests.support.bags import (
    Msg,
    battery,
    boolean,
    command,
    detections,
    diagnostics,
    goals,
    log_entry,
    write_splits,
)
from tests.support.moving_map import BEGIN, MS, S, moving_map

LENGTH_S = 60
NOISY_LABELS = ("mug", "scissors", "table", "ghost")
_NOISE_M = 0.01
_DRIFT_M = 0.0005
_RUNNING, _SUCCEEDED, _ABORTED = 2, 4, 6


def write_noisy_robot(name: str, bag_dir: Path) -> Path:
    """Writes a minute from `BEGIN` on; all that is random is drawn by the name."""
    draw = Random(name)
    _, messages = moving_map(draw, LENGTH_S, noise_m=_NOISE_M, drift_m=_DRIFT_M, rate=10)
    messages += [*_seen(draw), *_changes(draw)]
    write_splits(bag_dir, messages, 12, dated=True)
    return bag_dir


def _seen(draw: Random) -> list[Msg]:
    """Detections twice a second: some are missed, wrong, or weak."""
    found: list[Msg] = []
    for step in range(2 * LENGTH_S):
        at = BEGIN + step * 500 * MS + draw.randrange(50) * MS
        there = NOISY_LABELS[step // 15 % 3]
        labels = [each for each in (there,) if draw.random() < 0.8]
        labels += ["ghost"] if draw.random() < 0.05 else []
        place = draw.gauss(1.5, 0.1), draw.gauss(0.2, 0.1), 0.4
        score = round(draw.uniform(0.3, 0.95), 3)
        found.append(detections(at, labels, at=place, score=score))
    return found


def _changes(draw: Random) -> list[Msg]:
    """Booleans, statuses, logs, goals, a battery and commands."""
    found: list[Msg] = []
    is_pressed, is_bad, goal = False, False, 1
    for second in range(LENGTH_S):
        at = BEGIN + second * S + draw.randrange(900) * MS
        is_pressed ^= draw.random() < 0.2
        is_bad ^= draw.random() < 0.1
        found.append(boolean(at, is_pressed))
        lidar = (2, "no scan") if is_bad else (0, "ok")
        motors = (1 if draw.random() < 0.1 else 0, "warm")
        found.append(diagnostics(at + MS, lidar=lidar, motors=motors))
        if draw.random() < 0.3:
            level = draw.choice((20, 30, 40))
            found.append(
                log_entry(
                    at + 2 * MS, level, "planner", draw.choice(("no path", f"stuck at {second}"))
                )
            )
        if second % 4 == 0:
            ended = draw.choice((_RUNNING, _SUCCEEDED, _ABORTED))
            found.append(goals(at + 3 * MS, {goal - 1: _SUCCEEDED, goal: ended}))
            goal += ended != _RUNNING
        if second % 10 == 0:
            found.append(battery(at + 4 * MS, 0.21 - 0.001 * second))
        for part in range(5):
            speed = 0.0 if second % 9 == 8 else 0.4
            found.append(command(BEGIN + second * S + part * 200 * MS, speed))
    return found
