"""Commands `locate`, `serve-locate` and `bridge`: where a scan was taken, asked once, by robots, or all the time."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from topomerge.cli.console import (
    Command,
    build_option,
    check_inputs,
    find_signal,
    guard_printing,
    print_line,
    print_text,
    write_out,
)
from topomerge.cli.options import (
    READING_NAMES,
    READING_OPTIONS,
    SELECTIVE,
    build_json_option,
    build_output_option,
    build_quiet_option,
    check_cloud_options,
    collect_given,
    is_map,
    parse_positive,
    parse_share,
    parse_whole_number,
)
from topomerge.errors import InputError

PORT = 7654


def run_locate(args: argparse.Namespace) -> int:
    """`topomerge locate`: where in an atlas a scan was taken. Status 2: not here, or it can't be told."""
    check_inputs([args.input])
    check_cloud_options([args.input], args, [name for name in READING_NAMES if name not in ("drawing", "text", *SELECTIVE)])
    from dataclasses import replace

    from topomerge.fusion.atlas.locate import LOCATE, locate

    answer = locate(args.atlas, _load_scan(args), replace(LOCATE, **collect_given(args, "sure")))
    if args.json:
        write_out(json.dumps(answer.serialise(), indent=1, ensure_ascii=False) + "\n")
    else:
        print_text(answer.reason)
        rest = answer.places if answer.status != "located" else answer.places[1:]
        lines = [f"  {place.describe()}" for place in rest if place.probability >= 0.005]
        if lines and not args.quiet:
            print_text("\n".join(lines))
    return 0 if answer.status == "located" else 2


def _load_scan(args: argparse.Namespace) -> object:
    """Load the scan that `locate` is asked with."""
    if is_map(args.input):
        from topomerge.extraction.landmarks import load_map_with_landmarks

        return load_map_with_landmarks(args.input)
    from topomerge.io.points import read_chunks

    return read_chunks(args.input, **collect_given(args, *READING_NAMES))


def run_serve(args: argparse.Namespace) -> int:
    """`topomerge serve-locate`: answer until Ctrl-C or a termination."""
    from dataclasses import replace

    from topomerge.fusion.atlas.locate import LOCATE
    from topomerge.fusion.atlas.locate_server import LocateServer

    with LocateServer(args.atlas, args.host, args.port, replace(LOCATE, **collect_given(args, "sure"))) as server:
        if not args.quiet:
            print_line(f"serving {args.atlas} on {server.address[0]}:{server.address[1]} (Ctrl-C ends it)")
        with guard_printing():
            sys.stdout.flush()
        try:
            server.serve()
        except (KeyboardInterrupt, SystemExit) as stop:
            if not isinstance(find_signal(stop), KeyboardInterrupt):
                raise
    if not args.quiet:
        print_line(f"{server.answered} scans answered")
    return 0


def run_bridge(args: argparse.Namespace) -> int:
    """`topomerge bridge`: robots whose maps are joined while they drive."""
    from topomerge.fusion.live import hold_state

    if sum(bool(way) for way in (args.rosbridge, args.foxglove, args.mcap)) != 1:
        raise InputError("bridge: give one of --rosbridge, --foxglove and --mcap")
    with hold_state(Path(args.output)):
        return _join_robots(args, Path(args.output))


def _join_robots(args: argparse.Namespace, folder: Path) -> int:
    """Go through the stream, and say what came of it."""
    from topomerge.fusion.bridge import Bridge, parse_robots
    from topomerge.fusion.live import STATE_FILE, LiveMerger, describe_event
    from topomerge.io.streams import FOXGLOVE, Connection, StreamCounts, read_foxglove, read_mcap, read_rosbridge

    def tell(event: Mapping[str, Any]) -> None:
        print_line(json.dumps(event, ensure_ascii=False) if args.json else describe_event(event))
        with guard_printing():
            sys.stdout.flush()

    bridge = Bridge(LiveMerger(folder), parse_robots(args.robots), tell, **collect_given(args, "every"))
    topics, counts = bridge.list_topics(), StreamCounts()
    try:
        if args.rosbridge:
            with Connection(args.rosbridge, (), bridge.outbox, bridge.greet) as connection:
                bridge.run(read_rosbridge(connection, topics, counts))
        elif args.foxglove:
            with Connection(args.foxglove, FOXGLOVE) as connection:
                bridge.run(read_foxglove(connection, topics, counts))
        else:
            bridge.run(read_mcap(sys.stdin.buffer, topics, counts))
    except KeyboardInterrupt:
        pass
    if not args.quiet:
        message = ", ".join(f"{n} {what}" for what, n in sorted(bridge.counts.items())) or "nothing came"
        left_out = sum(robot.left_out for robot in bridge.merger.robots.values())
        full = f", {left_out:,} points left out, as a map was full" if left_out else ""
        kept = f"-> {args.output}" if (folder / STATE_FILE).exists() else "(nothing is written)"
        print_line(f"{counts.read} messages: {message}{full}; {counts.broken} unreadable {kept}", sys.stderr)
    return 0 if bridge.merger.links else 2


def parse_port(text: str) -> int:
    """Parse a port, 0 for any free one, as the `type` of an argument."""
    number = parse_whole_number(text)
    if number > 65535:
        raise argparse.ArgumentTypeError(f"must be a port from 0 to 65535, not {text}")
    return number


SURE = build_option("--sure", type=parse_share, metavar="P", help="probability from which on a place is told (default 0.9)")
LOCATE = Command(
    "locate",
    run_locate,
    "find where in an atlas a scan was taken",
    "topomerge locate house/ scan.ply",
    (
        build_option("atlas", metavar="ATLAS", help="an atlas (`topomerge atlas add`)"),
        build_option("input", metavar="SCAN", help="one scan, a slice, a frame with depth, a short walk, or a .tmap"),
        SURE,
        *READING_OPTIONS,
        build_json_option("print the answer as JSON: places with pose, covariance and probability"),
        build_quiet_option("print one line only"),
    ),
    paths=("input", "atlas"),
    description="Find building, storey, room and pose of a scan in an atlas. Status 2: it was not taken there, or several places "
    "look alike; these are named.",
)
SERVE = Command(
    "serve-locate",
    run_serve,
    "answer robots that ask where they are, over a socket",
    f"topomerge serve-locate house/ --port {PORT}",
    (
        build_option("atlas", metavar="ATLAS", help="an atlas"),
        build_option("--port", type=parse_port, default=PORT, metavar="N", help=f"port (default {PORT}; 0: any free one)"),
        build_option("--host", default="127.0.0.1", metavar="ADDRESS", help="address (default 127.0.0.1: this machine only)"),
        SURE,
        build_quiet_option(),
    ),
    paths=("atlas",),
    description="Answer line JSON over a socket: each line asks with points or the ranges of a laser, and landmarks, and gets "
    "one line back.",
)
BRIDGE = Command(
    "bridge",
    run_bridge,
    "join the maps of robots while they drive",
    "topomerge bridge -o live/ --rosbridge ws://localhost:9090 --robot a=/a/scan,/a/odom --robot b=/b/scan,/b/odom",
    (
        build_output_option("DIR", "folder of the state; it is gone on with when it is there"),
        build_option(
            "--robot",
            dest="robots",
            action="append",
            default=[],
            metavar="NAME=SCANS[,POSES]",
            help="a robot: topic of its scans, clouds or grids, and of its poses (odometry, poses, a tf of its own; default /tf)",
        ),
        build_option("--rosbridge", default="", metavar="URL", help="rosbridge server, as ws://localhost:9090; answers go back"),
        build_option("--foxglove", default="", metavar="URL", help="Foxglove websocket server, as ws://localhost:8765"),
        build_option("--mcap", action="store_true", default=False, help="an MCAP recording on standard input"),
        build_option("--every", type=parse_positive, metavar="S", help="seconds between two updates, at least (default 5)"),
        build_json_option("print each event as a line of JSON"),
        build_quiet_option("print events only"),
    ),
    paths=("output",),
    description="Keep one map a robot, join them when they are believed to show one place, and part them when evidence turns. "
    "Printed and published: the pose between joined maps, and what a robot should look at next. Status 2: nothing is joined.",
)
