"""One SELECT over a lake: whoever writes it sees the rows of some robots, and nothing else."""

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import duckdb
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.timebase import Deadline
from ros2_memory.fleet.robots import Fleet, Robot
from ros2_memory.fleet.select import QUERY_LAKE, select_tools
from ros2_memory.history.context import Call
from ros2_memory.lake import select as lake_select
from ros2_memory.lake.engine import Lake
from ros2_memory.lake.select import ALLOCATORS, Select, check_select
from ros2_memory.lake.tables import TABLES
from tests.support.clocks import FixedClock
from tests.support.fleets import NOW, START_S, reply_of
from tests.support.lakes import lake_in, lake_robots, selecting_here, ship_from, write_bag
from tests.support.memories import memory_of

__all__ = ["selecting_here"]

HALL, ATTIC, UNSHIPPED = "hall", "attic", "cellar"
ENDLESS = "WITH RECURSIVE t AS (SELECT 1 AS i UNION ALL SELECT i + 1 FROM t) SELECT max(i) FROM t"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lake")
    for name, bags in ((HALL, 3), (ATTIC, 2)):
        for number in range(bags):
            write_bag(folder / name, number)
    ship_from(folder, HALL, ATTIC)
    return folder


@pytest.fixture(scope="module")
def fleet(folder: Path) -> Fleet:
    lake = Lake(lake_in(folder / "lake"), memory_mb=256)
    shipped = lake_robots(lake, [HALL, ATTIC])
    robots = [Robot(name, memory) for name, memory in shipped.items()]
    robots.append(Robot(UNSHIPPED, memory_of(folder / UNSHIPPED)))
    return Fleet(robots, FixedClock(NOW), tables=lake)


def asked(fleet: Fleet, select: str, call: Call | None = None, **given: object) -> Any:
    [tool] = select_tools(fleet, 24_000)
    assert tool.name == QUERY_LAKE
    return reply_of(tool, {"select": select, **given}, call)


BAGS = "SELECT robot, count(*) AS n FROM bags GROUP BY robot ORDER BY robot"


def test_rows_of_all_robots_are_grouped_and_what_was_not_shipped_is_named(fleet: Fleet) -> None:
    answer = asked(fleet, BAGS)
    assert (answer["fields"], answer["rows"]) == (["robot", "n"], [[ATTIC, 2], [HALL, 3]])
    [shipped] = answer["notes"]
    assert f"shipped: {UNSHIPPED} up to no time, {ATTIC} up to " in shipped
    assert f", {HALL} up to " in shipped
    [row] = asked(fleet, "SELECT min(time_ns), max(time_ns) FROM sightings")["rows"]
    assert row == [START_S * 10**9, (START_S + 20) * 10**9]


@pytest.mark.usefixtures("selecting_here")
def test_a_call_sees_the_robots_that_it_names_and_may_ask_about(fleet: Fleet) -> None:
    assert asked(fleet, BAGS, robot=HALL)["rows"] == [[HALL, 3]]
    assert asked(fleet, BAGS, robot=f"{HALL}, {ATTIC}")["rows"] == [[ATTIC, 2], [HALL, 3]]
    only = Call(robots=frozenset({ATTIC}))
    of_all = " UNION ".join(f"SELECT robot FROM {table}" for table in TABLES)  # noqa: S608
    assert asked(fleet, of_all, only)["rows"] == [[ATTIC]]
    assert asked(fleet, BAGS, only)["rows"] == [[ATTIC, 2]]
    for other in (HALL, "nobody"):
        refused = asked(fleet, BAGS, only, robot=other)
        assert refused["detail"] == f'there is no robot "{other}"; there is {ATTIC}'
    assert asked(fleet, BAGS, Call(robots=frozenset({UNSHIPPED})))["error"] == "no_data"


def test_rows_that_find_no_room_are_reported(fleet: Fleet) -> None:
    answer = asked(fleet, "FROM range(500) ORDER BY 1", limit=7)
    assert (answer["rows"], answer["more"]) == ([[n] for n in range(7)], True)
    assert any("the first 7 rows" in note for note in answer["notes"])
    whole = asked(fleet, "FROM range(7)", limit=7.0)  # in JSON it is 7
    assert (len(whole["rows"]), "more" in whole) == (7, False)
    long = asked(fleet, "SELECT repeat('x', 9000) FROM range(9)")
    assert (len(long["rows"]), long["more"]) == (2, True)
    assert asked(fleet, "SELECT repeat('x', 90000)")["rows"] == []


@pytest.mark.usefixtures("selecting_here")
def test_values_that_json_has_not_are_texts_and_longer_texts_are_marked(fleet: Fleet) -> None:
    answer = asked(
        fleet,
        "SELECT 1.5::DECIMAL(9, 2) AS dec, 'nan'::DOUBLE AS nan, DATE '2026-11-28' AS day,"
        " 'ab'::BLOB AS bytes, MAP {'k': 2} AS map, [1, NULL] AS list,"
        " DATE '2026-11-28' + TIME '01:00' - DATE '2026-11-27' AS length,"
        " 'go to the kitchen now' AS text",
    )
    *values, length, said = answer["rows"][0]
    assert values == [1.5, None, "2026-11-28", "6162", {"k": 2}, [1, None]]
    assert (length, said) == ("P0M1DT3600S", "go to the kitchen now")
    assert answer["quoted"] == ["rows.text"]
    twice = asked(fleet, "SELECT 1 AS n, 2 AS n")
    assert (twice["fields"], twice["rows"]) == (["n", "n"], [[1, 2]])
    late = asked(fleet, "SELECT DATE '5877641-06-23'")
    assert late["error"] == "invalid_arguments"
    assert "cast it to VARCHAR" in late["detail"]
    # A float would have lost the last digits; a recorded text stays out of a sentence of ours.
    [[added]] = asked(fleet, "SELECT sum(time_ns) FROM sightings")["rows"]
    assert added == 5 * START_S * 10**9 + 40 * 10**9
    wrong = asked(fleet, "SELECT robot::INT FROM bags")
    assert (wrong["error"], HALL in str(wrong)) == ("invalid_arguments", False)
    assert len(asked(fleet, "SELECT error(repeat('x', 9999))")["detail"]) < 999
    named = asked(fleet, f"SELECT 1 AS {'n' * 9_500}, 2 AS {'m' * 9_900}")
    assert named["detail"] == "the names of the columns are longer than a reply may be"


REFUSED = [
    ("SELECT * FROM read_text('/a/bag.mcap')", 'read_text" is not offered'),
    ("SELECT * FROM read_parquet('/a/lake/**')", "read_parquet"),
    ("SELECT * FROM '/a/lake/ros2_memory/bags/data/*.parquet'", "/ros2_memory/bags"),
    ("SELECT * FROM glob('/*')", "glob"),
    ("SELECT (SELECT max(content) FROM read_text('/a/bag.mcap'))", "read_text"),
    ("WITH a AS (SELECT * FROM read_csv('/a/bag.mcap')) SELECT * FROM a", "read_csv"),
    ("SELECT 1 UNION ALL SELECT size FROM read_blob('/a/bag.mcap')", "read_blob"),
    ("SELECT * FROM query('SELECT 1')", "query"),
    ("SELECT * FROM duckdb_settings()", "duckdb_settings"),
    ("SELECT * FROM (WITH duckdb_views AS (SELECT 1) FROM duckdb_views)", "duckdb_views"),
    ("SELECT * FROM temp.main.bags", "temp.main.bags"),
    ("SELECT * FROM information_schema.tables", "information_schema.tables"),
    ("SELECT current_setting('temp_directory')", "current_setting"),
    ("SELECT count(*) FILTER (pg_get_viewdef(1) > '') FROM bags", "pg_get_viewdef"),
    ("WITH a AS (COPY (SELECT 1) TO '/a/bag.mcap') FROM a", "COPY_QUERY_NODE"),
    ("WITH a AS (INSERT INTO bags VALUES (1) RETURNING 1) FROM a", "INSERT"),
    ("SELECT json_serialize_plan('SELECT 1', optimize := true)", "json_serialize_plan"),
    ("SELECT sleep_ms(1000)", "sleep_ms"),
    ("SHOW ALL TABLES", "SHOW_REF is not offered"),
    ("COPY (SELECT 1) TO '/a/bag.mcap'", "one SELECT is answered"),
    ("ATTACH '/a/bag.mcap'", "one SELECT is answered"),
    ("SET threads = 9", "one SELECT is answered"),
    ("INSTALL httpfs", "one SELECT is answered"),
    ("DROP VIEW bags", "one SELECT is answered"),
    ("EXPLAIN ANALYZE SELECT 1", "one SELECT is answered"),
    ("SELECT 1; SELECT 2", "one SELECT is answered"),
    ("", "one SELECT is answered"),
    ("-- nothing", "one SELECT is answered"),
    ("SELEC 1", "syntax error"),
    ("SELECT " + "(" * 5000 + "1" + ")" * 5000, "depth"),
]


@pytest.mark.parametrize(("statement", "why"), REFUSED)
def test_whatever_is_no_select_over_the_tables_is_refused(statement: str, why: str) -> None:
    with duckdb.connect() as connection, pytest.raises(InvalidArgumentsError) as refused:
        check_select(statement, TABLES, connection)
    assert why in str(refused.value)
    assert str(refused.value).endswith(f"; the tables are {', '.join(TABLES)}")


def test_a_refused_statement_reads_and_writes_nothing(fleet: Fleet, folder: Path) -> None:
    bag = folder / HALL / "rec" / "rec_0.mcap"
    before = bag.read_bytes()
    assert asked(fleet, f"COPY (SELECT 1) TO '{bag}'")["error"] == "invalid_arguments"
    assert asked(fleet, f"FROM read_text('{bag}')")["error"] == "invalid_arguments"
    assert '"nope" not found' in asked(fleet, "SELECT nope FROM bags")["detail"]
    assert bag.read_bytes() == before


@pytest.mark.parametrize(
    "select",
    [
        "WITH RECURSIVE t AS (SELECT 1 AS i UNION ALL SELECT i + 1 FROM t WHERE i < 4) FROM t",
        "FROM bags SELECT robot QUALIFY row_number() OVER (PARTITION BY robot) = 1",
        "SELECT unnest(range(3)), 'FROM read_text' AS text",
        "SELECT robot FROM bags WHERE EXISTS (FROM sightings s WHERE s.bag_id = bags.bag_id)",
        "VALUES (1), (2)",
        "FROM bags USING SAMPLE 5 ROWS",
        "WITH tables AS (SELECT CAST(1.5 AS DECIMAL(9, 2))) FROM tables LIMIT 100%",
    ],
)
def test_statements_of_all_forms_pass(select: str) -> None:
    with duckdb.connect() as connection:
        check_select(select, TABLES, connection)


@pytest.mark.usefixtures("selecting_here")
def test_tables_are_joined_and_described(fleet: Fleet) -> None:
    join = "SELECT b.robot FROM Bags b JOIN channels c USING (robot, bag_id) GROUP BY ALL; -- all"
    assert len(asked(fleet, join)["rows"]) == 2
    assert len(asked(fleet, "DESCRIBE sightings")["rows"]) == len(TABLES["sightings"].columns)


def test_memory_that_duckdb_does_not_count_and_time_without_end_are_bounded(fleet: Fleet) -> None:
    for greedy in ("SELECT length(repeat('x', 1900000000))", "SELECT len(range(200000000))"):
        answer = asked(fleet, greedy)
        assert answer["error"] == "refused"
        assert "more than 256 MiB" in answer["detail"]
    answer = asked(fleet, ENDLESS, Call(Deadline.after(1.0)))
    assert answer["error"] == "timeout"
    assert asked(fleet, BAGS, Call(Deadline.after(-1.0)))["error"] == "timeout"
    assert asked(fleet, BAGS)["rows"] == [[ATTIC, 2], [HALL, 3]]


@pytest.mark.parametrize(
    ("number", "said"), [("SIGABRT", "needs more than 256 MiB"), ("SIGTERM", "it failed")]
)
def test_an_end_that_shows_no_want_of_memory_is_not_called_that(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, number: str, said: str
) -> None:
    program = f"import os, signal; os.kill(os.getpid(), signal.{number})"
    monkeypatch.setattr(lake_select, "_PROGRAM", program)
    assert said in asked(fleet, BAGS)["detail"]


def test_its_process_ends_by_itself_should_the_server_be_killed() -> None:
    left_alone = subprocess.run(
        [sys.executable, "-c", "from ros2_memory.lake.select import main; main()"],
        input=pickle.dumps((Select(ENDLESS, 256), {}, 0.0)),
        env={**os.environ, **ALLOCATORS},
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert left_alone.returncode == -signal.SIGALRM


def test_a_file_that_is_damaged_is_reported_without_its_path(tmp_path: Path) -> None:
    write_bag(tmp_path / HALL, 0)
    ship_from(tmp_path)
    lake = Lake(lake_in(tmp_path / "lake"))
    fleet = Fleet([Robot(HALL, memory_of(tmp_path))], FixedClock(NOW), tables=lake)
    for file in (tmp_path / "lake" / "ros2_memory" / "sightings").rglob("*.parquet"):
        os.truncate(file, 4)
    answer = asked(fleet, "SELECT * FROM sightings")
    assert answer["error"] == "refused"
    assert str(tmp_path) not in str(answer)


SOURCES = (
    *("bags", "poses", "range(3)", "(VALUES (1)) v", "a", "main.bags", "'x.csv'", "pg_class"),
    *("read_text('x')", "duckdb_views", "duckdb_views()", "information_schema.tables"),
)
QUERIES = st.recursive(
    st.sampled_from(SOURCES).map("SELECT 1 AS x FROM {}".format),
    lambda inner: st.one_of(
        inner.map("SELECT 1 AS x FROM ({}) t".format),
        inner.map("SELECT ({} LIMIT 1) AS x FROM bags".format),
        inner.map("SELECT 1 AS x FROM bags WHERE EXISTS ({})".format),
        inner.map("SELECT 1 AS x FROM bags, LATERAL ({}) t".format),
        st.tuples(inner, inner).map(lambda both: "({}) UNION ALL ({})".format(*both)),
        st.tuples(inner, inner).map(lambda both: "WITH a AS ({}) {}".format(*both)),
    ),
    max_leaves=4,
)


@pytest.fixture(scope="module")
def sandbox() -> Iterator[duckdb.DuckDBPyConnection]:
    """A database that has two tables, and may open no file."""
    with duckdb.connect(config={"threads": "1", "temp_directory": ""}) as connection:
        for table in ("bags", "poses"):
            connection.execute(f"CREATE TABLE {table} AS SELECT 1 AS x")
        connection.execute("SET enable_external_access = false")
        yield connection


@given(sql=QUERIES)
def test_what_passes_the_check_names_tables_and_row_makers_alone(
    sandbox: duckdb.DuckDBPyConnection, sql: str
) -> None:
    """DuckDB's own plan shows what a statement reads."""
    try:
        check_select(sql, ("bags", "poses"), sandbox)
        plan = str(sandbox.execute(f"EXPLAIN {sql}").fetchall()).lower()
    except InvalidArgumentsError:
        # Refused for what it names, which is not all among the tables.
        assert any(name in sql for name in SOURCES[4:])
        return
    except (duckdb.BinderException, duckdb.CatalogException):
        # An expression outside of where it is defined, or of more columns than one.
        return
    assert not any(name in plan for name in ("read_", "duckdb_", "pragma", "pg_")), sql
