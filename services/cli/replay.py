"""``endo3d replay``: a log through the services again."""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from endo3d.services.cli.options import JsonOption, SetOption

if TYPE_CHECKING:
    from endo3d.services.archive.reader import Log
    from endo3d.services.archive.recording import Recording
    from endo3d.services.runtime.replay import Result
    from endo3d.services.runtime.stack_file import Stack


def replay(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="The log (.mcap), or its parts in order.")],
    out: Annotated[Path | None, typer.Option("--out", help="Write the results into a new log.")] = None,
    stack: Annotated[str | None, typer.Option("--stack", help="Another stack file than the log's own.")] = None,
    overrides: SetOption = None,
    only: Annotated[list[str] | None, typer.Option("--only", help="Run only this service; repeatable.")] = None,
    topic: Annotated[
        list[str] | None, typer.Option("--topic", help="Feed only this topic of the log; repeatable.")
    ] = None,
    from_s: Annotated[float, typer.Option("--from", help="Start, in seconds into the log.")] = 0.0,
    to_s: Annotated[float, typer.Option("--to", help="End, in seconds into the log.")] = float("inf"),
    rate: Annotated[
        float | None,
        typer.Option("--rate", help="Play through the live stack instead, at so many times the recorded pace."),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start over at the end; with --rate.")] = False,
    digest: Annotated[
        bool, typer.Option("--digest", help="Hash the results: equal replays have equal digests.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run a log through the services again, as fast as this machine allows.

    The stack file and the calibration are those in the log. Equal input and configuration give equal bits.

    With --rate the log takes the camera's place in the running stack, with every process and viewer.

    Examples: endo3d replay scan.mcap --digest; endo3d replay scan.mcap --set decoder.bin_px=2 --out fine.mcap;
    endo3d replay scan_*.mcap --only decoder; endo3d replay scan.mcap --rate 1 --loop
    """
    from endo3d.schemas import topics
    from endo3d.services.archive.reader import Log
    from endo3d.services.runtime import replay as engine
    from endo3d.services.runtime.errors import UserError

    parts = [Log(path) for path in logs]
    first, last = parts[0], parts[-1]
    if unknown := set(topic or ()) - topics.BY_NAME.keys():
        raise UserError(f"no topic {', '.join(sorted(unknown))}; there are {', '.join(topics.BY_NAME)}")
    if loop and rate is None:
        raise UserError("--loop repeats a live replay; add --rate 1")
    if rate is not None:
        if len(parts) > 1:
            raise UserError("a player takes one log; play the parts one by one")
        with engine.stack_of(first, stack, overrides or ()) as described:
            _live(engine.live_stack(described, first.path, rate=rate, loop=loop, start_s=from_s, end_s=to_s, out=out))
    start_ns = first.start_ns + round(from_s * 1e9)
    end_ns = min(last.end_ns + 1, first.start_ns + round(min(to_s, 1e9) * 1e9))
    digests = engine.Digest() if digest else None
    counts: Counter[str] = Counter()
    with (
        engine.stack_of(first, stack, overrides or ()) as described,
        engine.pipeline_of(described, only or ()) as pipeline,
        _recording(out, first, described) as into,
    ):
        started = time.perf_counter()
        results = chain.from_iterable(
            engine.replay(
                part,
                pipeline,
                inputs=[topics.BY_NAME[name] for name in topic or ()],
                start_ns=start_ns,
                end_ns=end_ns,
                into=into,
                digest=digests,
            )
            for part in parts
        )
        for result in _progress(results, start_ns, end_ns):
            counts[topics.of(result.message).name] += 1
        took_s = time.perf_counter() - started
    recorded_s = max(0, end_ns - start_ns) * 1e-9
    report: dict[str, Any] = {
        "recorded_s": recorded_s,
        "took_s": took_s,
        "times_real_time": recorded_s / took_s,
        "results": dict(counts),
        "digests": digests.as_dict() if digests else {},
        "files": [str(part) for part in into.parts] if into is not None else [],
    }
    report["calibration"] = _calibration(first)
    print(json.dumps(report, indent=2) if as_json else _text(report))


def _calibration(log: Log) -> str:
    """How good the calibration is that the log was made with, in a line."""
    from endo3d.schemas import topics
    from endo3d.schemas.messages import ProjectorCalibration
    from endo3d_core.calibrating.quality import Quality

    for message in log.messages(topics.PROJECTOR):
        if isinstance(message, ProjectorCalibration):
            return Quality.from_yaml(message.yaml).line
    return "calibration: none in this log"


def _live(stack_toml: str) -> NoReturn:
    """The stack, started; ends with the log, or Ctrl-C."""
    from endo3d.services.cli.up import up

    with tempfile.TemporaryDirectory(prefix="endo3d-") as folder:
        path = Path(folder) / "replay.toml"
        path.write_text(stack_toml, encoding="utf-8")
        up(str(path))
    raise typer.Exit


@contextmanager
def _recording(out: Path | None, log: Log, stack: Stack) -> Iterator[Recording | None]:
    from endo3d.services.runtime.replay import recording_of

    if out is None:
        yield None
        return
    recording = recording_of(out, log, stack)
    try:
        yield recording
    finally:
        recording.finish()


def _progress(results: Iterable[Result], start_ns: int, end_ns: int) -> Iterator[Result]:
    """Passes the results on and draws how far into the log they are, on stderr if that is a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("replay", total=max(1, end_ns - start_ns))
        for result in results:
            bar.update(task, completed=result.cause.log_ns - start_ns)
            yield result


def _text(report: dict[str, Any]) -> str:
    lines = [
        f"{report['recorded_s']:.2f} s of the log in {report['took_s']:.2f} s: "
        f"{report['times_real_time']:.1f} x real time"
    ]
    lines.append(report["calibration"])
    for name, count in report["results"].items():
        lines.append(f"  {name:12s} {count:8d}  {report['digests'].get(name, '')}")
    return "\n".join(lines + [f"  wrote {name}" for name in report["files"]])
