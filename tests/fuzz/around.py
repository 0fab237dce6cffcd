"""Mutations of what lies around a bag: metadata, links, rights, names, and files that change."""

import os
import random
import socket
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random

from tests.fuzz.good import Good, goods
from tests.fuzz.mutant import Mutant, Trap, mutant_file

_METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: {storage}
  relative_file_paths:
    - {name}
  duration:
    nanoseconds: {number}
  starting_time:
    nanoseconds_since_epoch: {number}
  message_count: {number}
  topics_with_message_count:
    - topic_metadata:
        name: /elsewhere
        type: std_msgs/msg/Nothing
        serialization_format: cdr
        offered_qos_profiles: ""
      message_count: {number}
  compression_format: {compression}
  compression_mode: {mode}
"""
_BESIDE = ("metadata.yaml", "handover.json", "../recorder.json", "../latched/carried.mcap")
_NAMES = (
    "two\nlines",
    "tab\tand\rreturn",
    "\u202egab",
    "\u2066left\u2069\u200b",
    "e\u0301",
    "\x1b[31mred\x1b[0m",
    "\x7f\x01",
    "'; DROP TABLE bags; --",
    "..%2f..%2fetc",
    "%s%n{0}{}$(x)`x`",
    " ",
    "-rf",
    "~",
    "*?[a-z]",
    "CON",
    "a" * 200,
    "\udcff\udcfe",
    "\U0001f916",
    "bag_0.mcap.mcap",
    '"quoted"\\',
)


def foreign_metadata(rng: Random, good: Good) -> Mutant:
    """The metadata.yaml, sidecar or heartbeat of another recording, or something else for one."""
    mutant = mutant_file(good, good.whole)
    content = rng.choice(
        (
            _METADATA.format(
                storage=rng.choice(("mcap", "sqlite3", "other")),
                name=rng.choice((mutant.bag, "other_0.mcap", "../../near_after/near_after_0.mcap")),
                number=rng.choice((0, -1, 10**6, 1 << 63, 10**30)),
                compression=rng.choice(("", "zstd", "lz4")),
                mode=rng.choice(("", "FILE", "MESSAGE")),
            ).encode(),
            b"",
            b"\0" * 1000,
            b"&a [" + b"*a," * 100 + b"]",
            b"a: &a [x,x]\nb: &b [*a,*a]\nc: &c [*b,*b]\n" * 20,
            b"[" * 100_000,
            b"!!python/object/apply:os.system ['true']",
            rng.randbytes(1000),
            b"- " + mutant.bag.encode() + b"\n" + b"x" * 1_000_000,
            b'{"format": 1, "state": "hidden", "clock": "publish", "notes": []}',
            b'{"pid": 1, "recordings": ["mutant"], "updated": 9e999}',
        )
    )
    mutant.files[rng.choice(_BESIDE)] = content
    if rng.random() < 0.3:
        mutant.files["metadata.yaml"] = content
    return mutant


def symlink_loops(rng: Random, good: Good) -> Mutant:
    """Links to themselves, to one another, up the tree, out of it, and to nothing."""
    mutant = mutant_file(good, good.whole)
    chosen = [rng.choice(_LINKS) for _ in range(rng.choice((1, 2, 5)))]

    def lay(folder: Path) -> None:
        for number, (name, target) in enumerate(chosen):
            link = folder / f"{number}{name}"
            with suppress(OSError):
                link.symlink_to(target.format(name=link.name, folder=folder, number=number))

    mutant.lay = lay
    return mutant


_LINKS = (
    (".mcap", "{name}"),
    ("", "."),
    ("", ".."),
    ("", "{folder}"),
    ("", "/"),
    (".mcap", "/dev/zero"),
    (".db3", "/proc/self/mem"),
    (".mcap", "bag_0.mcap"),
    ("x", "{number}x"),
    (".mcap", "nowhere"),
    ("", "/proc/self/root"),
    (".mcap", "a/" * 100),
)


def unreadable_files(rng: Random, good: Good) -> Mutant:
    """A folder, a pipe, a socket, a device or a locked file where a file should be."""
    mutant = mutant_file(good, good.whole)
    places = (mutant.bag, mutant.bag, "odd_1" + good.suffix, *_BESIDE[:3], mutant.bag + "-wal")
    where, make = rng.choice(places), rng.choice(_THINGS)

    def lay(folder: Path) -> None:
        path = folder / where
        with suppress(FileNotFoundError):
            path.unlink()
        with suppress(OSError):
            make(path)

    mutant.lay = lay
    mutant.told = f"{where}: {make.__name__}"
    return mutant


def _folder(path: Path) -> None:
    path.mkdir()


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    before = Path.cwd()
    # The address of a socket has room for 100 characters.
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(path.name)
    finally:
        os.chdir(before)


def _device(path: Path) -> None:
    os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 5))


def _locked(path: Path) -> None:
    path.write_bytes(b"locked")
    path.chmod(0)


def _sparse(path: Path) -> None:
    """A file that states to hold far more than the disk has."""
    with path.open("wb") as stream:
        stream.write(goods()[0].plain[:-8])
        stream.truncate(1 << 40)
        stream.seek((1 << 40) - 8)
        stream.write(goods()[0].plain[-8:])


def _empty(path: Path) -> None:
    path.touch()


_THINGS: tuple[Callable[[Path], None], ...] = (
    _folder,
    _pipe,
    _socket,
    _device,
    _locked,
    _sparse,
    _empty,
)


def shrinks(rng: Random, good: Good) -> Mutant:
    """The file becomes shorter, or is written over, while it is read."""
    mutant = mutant_file(good, good.whole)
    size, keep = len(good.whole), rng.random()
    scribble = rng.random() < 0.3

    def spring(path: Path) -> None:
        with suppress(OSError):
            if scribble:
                with path.open("r+b") as stream:
                    stream.seek(int(size * keep))
                    stream.write(random.Random(size).randbytes(300))
            else:
                os.truncate(path, int(size * keep) if keep > 0.1 else 0)

    mutant.trap = Trap(rng.choice((1, 2, 3, 5, 8, 13, 30, 80)), spring)
    return mutant


def vanishes(rng: Random, good: Good) -> Mutant:
    """The file is deleted, renamed, or becomes something else, while it is read."""
    mutant = mutant_file(good, good.whole)
    other = rng.choice(goods())
    do = rng.randrange(6)

    def spring(path: Path) -> None:
        with suppress(OSError):
            if do == 1:
                path.rename(path.with_name("renamed_0" + good.suffix))
                return
            if do == 2:
                path.parent.rename(path.parent.with_name("moved"))
                return
            path.unlink()
            if do == 3:
                path.mkdir()
            elif do == 4:
                path.write_bytes(other.whole)
            elif do == 5:
                path.symlink_to("/dev/zero")

    mutant.trap = Trap(rng.choice((1, 2, 3, 5, 8, 13, 30, 80)), spring)
    return mutant


def odd_names(rng: Random, good: Good) -> Mutant:
    """Names of files and folders with what no name should have in it."""
    data = good.whole if rng.random() < 0.5 else good.whole[: len(good.whole) // 2]
    name = rng.choice(_NAMES) + good.suffix
    inner = rng.choice(("", "", f"{rng.choice(_NAMES)}/"))
    return Mutant(inner + name, {inner + name: data}, told=repr(inner + name))
