"""The classes of mutation: which functions make each, out of which good bags."""

import random
from collections.abc import Callable
from dataclasses import dataclass

from tests.fuzz import around, bombs, bytewise, content, definitions, indexes, tables
from tests.fuzz.good import Good, goods, mcaps, sqlites
from tests.fuzz.mutant import Mutant, Mutation


@dataclass(frozen=True)
class MutationClass:
    """One class: its mutations, each as likely as it is often named, and its good bags."""

    mutations: tuple[Mutation, ...]
    out_of: Callable[[], tuple[Good, ...]] = goods


CLASSES: dict[str, MutationClass] = {
    "bit_flips": MutationClass((bytewise.flip_bits, bytewise.flip_bits_beneath_checksums)),
    "truncation": MutationClass((bytewise.cut, bytewise.cut_inside_a_chunk, bytewise.cut_out)),
    "spliced_chunks": MutationClass((content.splice,)),
    "wrong_lengths": MutationClass((bytewise.wrong_length, bytewise.wrong_length_inside)),
    "absurd_numbers": MutationClass(
        (bytewise.absurd_number, bytewise.absurd_number, bytewise.absurd_footer)
    ),
    "odd_payloads": MutationClass((content.odd_payloads, content.odd_payloads, content.odd_json)),
    "odd_times": MutationClass((content.odd_times,)),
    "swapped_schemas": MutationClass((content.swap_schemas, content.swap_schema_numbers)),
    "cyclic_definitions": MutationClass((definitions.cyclic_definition,)),
    "gigantic_definitions": MutationClass((definitions.gigantic_definition,)),
    "zstd_bombs": MutationClass(
        (
            bombs.chunk_bomb,
            bombs.lying_frame,
            bombs.message_bomb,
            bombs.wide_message,
            bombs.file_bomb,
        )
    ),
    "lz4_bombs": MutationClass(
        (bombs.lz4_chunk_bomb, bombs.lz4_lying_frame, bombs.lz4_wide_message), mcaps
    ),
    "sqlite_missing_tables": MutationClass((tables.missing_tables,), sqlites),
    "sqlite_wrong_types": MutationClass((tables.wrong_types,), sqlites),
    "sqlite_hostile": MutationClass(
        (tables.hostile_schema, tables.looping_pages, tables.odd_journals), sqlites
    ),
    "message_indexes": MutationClass(
        (indexes.flip_message_index, indexes.wrong_message_index), mcaps
    ),
    "chunk_indexes": MutationClass(
        (
            indexes.wrong_chunk_index,
            indexes.wrong_chunk_head,
            indexes.one_lie,
            indexes.lies_together,
        ),
        mcaps,
    ),
    "statistics": MutationClass((indexes.wrong_statistics,), mcaps),
    "sqlite_indexes": MutationClass((indexes.wrong_order, indexes.flip_index_page), sqlites),
    "foreign_metadata": MutationClass((around.foreign_metadata,)),
    "symlink_loops": MutationClass((around.symlink_loops,)),
    "unreadable_files": MutationClass((around.unreadable_files,)),
    "shrinking_files": MutationClass((around.shrinks,)),
    "vanishing_files": MutationClass((around.vanishes,)),
    "odd_names": MutationClass((around.odd_names,)),
}


@dataclass(frozen=True)
class Job:
    """One mutant by what makes it, and how it is asked. The same job makes the same mutant."""

    name: str
    number: int
    seed: int

    @property
    def rng(self) -> random.Random:
        return random.Random(f"{self.name} {self.number} {self.seed}")

    @property
    def place(self) -> int:
        """A number that no other mutant of the same seed has; small, for it becomes a time."""
        return [*CLASSES].index(self.name) * 100_000 + self.number

    def made(self) -> tuple[Mutant, Good, str]:
        """The mutant, the good bag that it was, and the mutation's name."""
        rng, its = self.rng, CLASSES[self.name]
        good = rng.choice(its.out_of())
        mutation = rng.choice(its.mutations)
        return mutation(rng, good), good, mutation.__name__
