"""ros2-memory: a robot's episodic memory.

Two programs share a directory of bags and nothing else. The **recorder**
(`ros2_memory.recorder.__main__`) supervises `ros2 bag record`; the **query server**
(`ros2_memory.server`) answers questions about closed bags over MCP. Neither needs the other to run.

Modules at the top::

    programs        where the three programs begin
    server          the query server
    bootstrap       composition root; bootstrap_fleet: of many robots and of a lake
    config          the configuration: models, loading, errors, sources
    queries         one function for each tool of the specification
    extract         the fields, poses and transforms that the schema map names
    typestore       message definitions

Rooms, from the bottom up. A room imports only from rooms below it::

    core            errors, time, the domain model, geometry, text, logging, telemetry port,
                    units and keys of replies
    storage         bag readers and writers; storage.mcap: the MCAP format
    messages        a decoded message as JSON: its fields, conversions, detections
    bag_dir         the contract between the two programs: file names, heartbeat, handover, lock,
                    own recordings, saved moments, requests, state of rules
    analysis        pure mathematics: transform tree, odometry, paths, intervals, conditions
    index           directory scan -> file state -> bag table -> timeline -> snapshot
    retention       garbage collection, latched carry-forward, repair, saved moments
    triggers        rules that keep what was recorded around an event
    recorder        the recorder; recorder.process: the child; recorder.handover: rotation
    columns         closed bags decoded once, as columns in SQLite; scanned by questions
    results         what queries and insights return: each class declares the keys of its reply
    history         one call's view across many bags
    things          what detectors saw, as instances with places and a history
    places          where the robot was: in the map, in regions, in named places
    counts          how often, how long and how far in each day, hour or weekday
    insights        the tools beyond the specification
    tools           declarations, arguments, replies as JSON
    fleet           the tools of one robot, asked of many, and their replies as one
    lake            closed bags of many robots as rows of Iceberg tables (the extra `lake`)
    serving         dispatch, MCP, HTTP, access, limits, health
    observability   Prometheus, OpenTelemetry
    demo            the simulated robot of `ros2-memory demo`
    cli             `ros2-memory`

A call: `serving.mcp_server` -> `serving.dispatch` -> a declaration in `tools` -> a function in
`queries`, `insights` or `things` -> `history.view` over `index.snapshot` -> a `storage` adapter ->
`extract` -> `results` -> `tools.replies`. docs/architecture.md has the whole picture.
"""

from typing import Final

PACKAGE: Final = "ros2-memory"


def package_version() -> str:
    """Returns the installed version of this package; `0` where it is not installed."""
    from importlib import metadata  # noqa: PLC0415 - 30 ms of every start, for one reply

    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        return "0"
