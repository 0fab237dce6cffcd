"""The classes of mutation: which functions make each, out of which good bags."""

import random
from dataclasses import dataclass

from tests.fuzz import around, bombs, bytewise, content, definitions, indexes, tables
from tests.fuzz.good import Good, goods, mcaps, sqlites
from tests.fuzz.mutant import Mutant, Mutation

CLASSES: dict[str, tuple[Mutation, ...]] = {
    "bit_flips": (bytewise.flip_bits, bytewise.flip_bits_beneath_checksums),
    "truncation": (bytewise.cut, bytewise.cut_inside_a_chunk, bytewise.cut_out),
    "spliced_chunks": (content.splice,),
    "wrong_lengths": (bytewise.wrong_length, bytewise.wrong_length_inside),
    "absurd_numbers": (bytewise.absurd_number, bytewise.absurd_number, bytewise.absurd_footer),
    "odd_payloads": (content.odd_payloads, content.odd_payloads, content.odd_json),
    "odd_times": (content.odd_times,),
    "swapped_schemas": (content.swap_schemas, content.swap_schema_numbers),
    "cyclic_definitions": (definitions.cyclic_definition,),
    "gigantic_definitions": (definitions.gigantic_definition,),
    "zstd_bombs": (
        bombs.chunk_bomb,
        bombs.lying_frame,
        bombs.message_bomb,
        bombs.wide_message,
        bombs.file_bomb,
    ),
    "lz4_bombs": (bombs.lz4_chunk_bomb, bombs.lz4_lying_frame, bombs.lz4_wide_message),
    "sqlite_missing_tables": (tables.missing_tables,),
    "sqlite_wrong_types": (tables.wrong_types,),
    "sqlite_hostile": (tables.hostile_schema, tables.looping_pages, tables.odd_journals),
    "message_indexes": (indexes.flip_message_index, indexes.wrong_message_index),
    "chunk_indexes": (
        indexes.wrong_chunk_index,
        indexes.wrong_chunk_head,
        indexes.one_lie,
        indexes.lies_together,
    ),
    "statistics": (indexes.wrong_statistics,),
    "sqlite_indexes": (indexes.wrong_order, indexes.flip_index_page),
    "foreign_metadata": (around.foreign_metadata,),
    "symlink_loops": (around.symlink_loops,),
    "unreadable_files": (around.unreadable_files,),
    "shrinking_files": (around.shrinks,),
    "vanishing_files": (around.vanishes,),
    "odd_names": (around.odd_names,),
}
"""The mutations of each class, each as likely as it is often named."""
_OF_MCAP = {"lz4_bombs", "message_indexes", "chunk_indexes", "statistics"}


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
        rng = self.rng
        out_of = sqlites if self.name.startswith("sqlite") else goods
        good = rng.choice(mcaps() if self.name in _OF_MCAP else out_of())
        mutation = rng.choice(CLASSES[self.name])
        return mutation(rng, good), good, mutation.__name__
