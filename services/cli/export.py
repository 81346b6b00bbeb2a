"""``endo3d export``: a log in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from endo3d.services.runtime.errors import UserError

if TYPE_CHECKING:
    from endo3d.schemas.messages import Cloud, Message
    from endo3d.schemas.topics import Topic
    from endo3d.services.archive.reader import Log


def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log, LOG.mcap.")],
    targets: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[FILE]...",
            help="The merged map as .ply .pcd .xyz .e57, a surface through it as .stl .obj, "
            "the way of the tip as .tum .csv: the name says it.",
        ),
    ] = None,
    clouds: Annotated[
        Path | None, typer.Option("--clouds", metavar="FOLDER", help="Every single cloud of the log.")
    ] = None,
    clouds_as: Annotated[str, typer.Option("--clouds-as", help="ply, pcd, xyz or e57.")] = "ply",
    cloud: Annotated[
        Path | None, typer.Option("--cloud", metavar="FILE", help="One cloud: the last, or see --sequence.")
    ] = None,
    depth: Annotated[
        Path | None,
        typer.Option(
            "--depth", metavar="FOLDER|FILE", help="Every depth map, and their scales; or one as .npy .png .tiff."
        ),
    ] = None,
    phase: Annotated[
        Path | None, typer.Option("--phase", metavar="FILE", help="Absolute phase of one cloud, rad, as .npy.")
    ] = None,
    sequence: Annotated[
        int | None, typer.Option("--sequence", help="Of the one cloud or depth map; by default the last.")
    ] = None,
    depth_as: Annotated[str, typer.Option("--depth-as", help="png, tiff (16 bit) or npy (mm).")] = "png",
    ros2: Annotated[
        Path | None, typer.Option("--ros2", metavar="FOLDER", help="A ROS 2 bag (MCAP), in metres.")
    ] = None,
    method: Annotated[
        str, typer.Option("--method", help="Of a surface: poisson or ball-pivoting.")
    ] = "poisson",
) -> None:
    """Write clouds, surfaces, depth maps, trajectories or a ROS 2 bag from a log.

    Examples: endo3d export scan.mcap map.ply way.tum; endo3d export scan.mcap --depth depth --ros2 bag;
    endo3d export still.mcap --cloud still.ply --depth still.npy --phase phase.npy
    """
    from endo3d.services.archive.reader import Log

    if not any((targets, clouds, cloud, depth, phase, ros2)):
        raise UserError(
            "nothing to export: name a file (map.ply, way.tum, ...), or --cloud, --clouds, --depth, --phase, --ros2"
        )
    opened = Log(log)
    for target in targets or ():
        _file(opened, target, method)
    if clouds is not None:
        _clouds(opened, clouds, clouds_as)
    if cloud is not None:
        from endo3d.services.exchange.clouds import write_cloud

        _say(write_cloud(_one_cloud(opened, sequence).points, cloud), "points", cloud)
    if depth is not None and depth.suffix:
        _one_depth(opened, depth, sequence)
    elif depth is not None:
        _depth(opened, depth, depth_as)
    if phase is not None:
        _phase(opened, phase, sequence)
    if ros2 is not None:
        _bag(opened, ros2)


def _file(log: Log, target: Path, method: str) -> None:
    from endo3d.schemas import topics
    from endo3d.schemas.messages import Pose
    from endo3d.services.exchange import clouds, surface, track
    from endo3d.services.views.scan import Scan

    suffix = target.suffix.lower()
    known = {*clouds.WRITERS, *surface.SUFFIXES, *track.SUFFIXES}
    if suffix not in known:
        raise UserError(
            f"no format {suffix or target.name!r}; a file ends in one of {' '.join(sorted(known))}"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    if suffix in track.SUFFIXES:
        poses = [message for message in log.messages(topics.POSE) if isinstance(message, Pose)]
        _say(track.write_track(poses, target), "poses", target)
        return
    scan = Scan.of(log.messages(topics.MAP, topics.CLOUD, topics.POSE))
    if suffix in clouds.WRITERS:
        _say(clouds.write_cloud(scan.points(), target), "points", target)
    else:
        viewer = scan.viewer()
        _say(surface.write_surface(scan.points(), target, method=method, viewer=viewer), "triangles", target)


def _clouds(log: Log, folder: Path, kind: str) -> None:
    from endo3d.schemas import topics
    from endo3d.schemas.messages import Cloud
    from endo3d.services.exchange.clouds import write_cloud

    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for message in log.messages(topics.CLOUD):
        if isinstance(message, Cloud):
            write_cloud(message.points, folder / f"{message.sequence:08d}.{kind}")
            count += 1
    _say(count, "clouds", folder)


def _depth(log: Log, folder: Path, kind: str) -> None:
    from endo3d.schemas import topics
    from endo3d.schemas.messages import DepthMap
    from endo3d.services.exchange.depth import write_depth_maps

    maps = (message for message in log.messages(topics.DEPTH) if isinstance(message, DepthMap))
    _say(write_depth_maps(maps, folder, kind), "depth maps", folder)


def _one_cloud(log: Log, sequence: int | None) -> Cloud:
    from endo3d.schemas import topics
    from endo3d.schemas.messages import Cloud

    found = _one(log, topics.CLOUD, sequence)
    assert isinstance(found, Cloud)
    return found


def _one_depth(log: Log, target: Path, sequence: int | None) -> None:
    from endo3d.schemas import topics
    from endo3d.schemas.messages import DepthMap
    from endo3d.services.exchange.depth import write_depth_map

    found = _one(log, topics.DEPTH, sequence)
    assert isinstance(found, DepthMap)
    _say(write_depth_map(found, target), "pixels", target)


def _phase(log: Log, target: Path, sequence: int | None) -> None:
    from endo3d.services.archive.entry import CALIBRATION_FILE
    from endo3d.services.exchange.phase import write_phase
    from endo3d_core.calibration import Rig

    calibration = log.attachments.get(CALIBRATION_FILE)
    if calibration is None:
        raise UserError(f"{log.path} carries no calibration; without it there is no phase")
    _say(write_phase(_one_cloud(log, sequence), Rig.from_yaml(calibration.decode()), target), "pixels", target)


def _one(log: Log, topic: Topic, sequence: int | None) -> Message:
    """The message of that number, or the last. Raises ``UserError`` when there is none."""
    last = None
    for message in log.messages(topic):
        if sequence is None or getattr(message, "sequence", None) == sequence:
            last = message
    if last is None:
        which = "" if sequence is None else f" with sequence {sequence}"
        raise UserError(f"{log.path} holds no {topic.name}{which}; `endo3d replay LOG --out OUT` decodes the frames")
    return last


def _bag(log: Log, folder: Path) -> None:
    from endo3d.services.exchange.ros2_bag import write_ros2_bag

    counts = write_ros2_bag(log.messages(), folder)
    print(f"{folder}: " + ", ".join(f"{topic} {count}" for topic, count in counts.items()))


def _say(count: int, what: str, target: Path) -> None:
    print(f"{target}: {count} {what}")
