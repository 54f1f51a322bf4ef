"""Where clips are shown: a Rerun file, a web page on this machine's loopback, or Rerun's window.

A sheet is a recording in Rerun's sense: one clip, or several side by side. Several sheets make a list to step through;
all of them are in one file, or in one viewer.
"""

import subprocess
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import rerun as rr

from lfd.core.errors import OutputError
from lfd.planning.signed_distances import Shape
from lfd.replay.clip import Clip
from lfd.replay.rerun_scene.blueprints import beside_blueprint, blueprint_of, kind_of
from lfd.replay.rerun_scene.clips import log_clip
from lfd.replay.viewer_process import open_window, program, serving

APPLICATION = "lfd"


@dataclass(frozen=True)
class Sheet:
    """What is seen at a time."""

    title: str
    clips: tuple[Clip, ...]
    """One, or several side by side."""
    listed: bool = False
    """Whether it is one of a list."""
    plays: bool = True
    """Whether time runs by itself and begins again; else it stands at the end."""


def replay(clip: Clip, *, save: Path | None, overwrite: bool = False, shapes: Sequence[Shape] = ()) -> None:
    """Write a clip, with shapes that its model does not have, to the file `save`, or open the viewer.

    Raises `OutputError` when the file exists or cannot be written, or when there is no screen.
    """
    sheets = [Sheet(clip.title, (replace(clip, shapes=(*clip.shapes, *shapes)),))]
    if save is None:
        show_in_window(sheets)
    else:
        write_file(sheets, save, overwrite=overwrite)


def check_save(save: Path, *, overwrite: bool) -> None:
    """Refuse a file that exists, before any work is done. Raises `OutputError`."""
    if save.exists() and not overwrite:
        raise OutputError(f"{save} exists already; choose another --save, or add --overwrite to replace it")


def write_file(sheets: Iterable[Sheet], save: Path, *, overwrite: bool) -> None:
    """Write sheets into one file, which appears under its name when it is whole.

    (Rerun's own file sink leaves a half-written file behind when the disk is full.) Raises `OutputError` when the file
    exists or cannot be written.
    """
    check_save(save, overwrite=overwrite)
    try:
        save.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=save.parent, prefix=f".{save.name}.") as folder:
            parts = [_written(sheet, Path(folder) / f"{number}.rrd") for number, sheet in enumerate(sheets)]
            whole = parts[0] if len(parts) == 1 else _merged(parts, Path(folder) / "whole.rrd")
            whole.replace(save)
    except OSError as error:
        raise OutputError(f"cannot write {save}: {error.strerror}; free space or choose another --save") from error


def _written(sheet: Sheet, path: Path) -> Path:
    """A file with one sheet."""
    recording = _recording(sheet)
    stream = recording.binary_stream()
    log_sheet(recording, sheet)
    path.write_bytes(stream.read() or b"")
    return path


def _merged(parts: Sequence[Path], whole: Path) -> Path:
    """One file of several. (Files that are only joined have tables of contents in their middle.)"""
    command = [program(), "rrd", "merge", *map(str, parts), "-o", str(whole)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise OutputError(f"Rerun cannot join the episodes into one file; choose fewer. It says:\n{done.stderr}")
    return whole


def send(sheets: Iterable[Sheet], source: str) -> None:
    """Send sheets to the viewer that takes data at the address `source`."""
    for sheet in sheets:
        recording = _recording(sheet)
        recording.connect_grpc(source)
        log_sheet(recording, sheet)
        recording.disconnect()


def show_in_window(sheets: Iterable[Sheet]) -> None:
    """Open Rerun's window with sheets. Raises `OutputError` without a screen."""
    send(sheets, open_window())


@contextmanager
def served(sheets: Iterable[Sheet]) -> Iterator[str]:
    """The address of a page that shows sheets while the block runs.

    Raises `LfdError` when Rerun's server does not start.
    """
    with serving() as (address, source):
        send(sheets, source)
        yield address


def serve(sheets: Iterable[Sheet], tell: Callable[[str], None], until: threading.Event | None = None) -> str:
    """Serve sheets until Ctrl-C, or until an event; `tell` gets the address, which is also returned at the end.

    Raises `LfdError` when Rerun's server does not start.
    """
    with serving() as (address, source), suppress(KeyboardInterrupt):  # how a person ends it
        tell(address)
        send(sheets, source)
        (until or threading.Event()).wait()
    return address


def _recording(sheet: Sheet) -> rr.RecordingStream:
    """A new recording; those with the same layout share an application, to which Rerun binds layouts."""
    first, *others = sheet.clips
    layout = f"beside_{1 + len(others)}" if others else kind_of(first)
    return rr.RecordingStream(f"{APPLICATION}_{layout}")


def log_sheet(recording: rr.RecordingStream, sheet: Sheet) -> None:
    """Log all of a sheet, and wait until it is out."""
    recording.send_recording_name(sheet.title)
    if len(sheet.clips) == 1:
        recording.send_blueprint(blueprint_of(sheet.clips[0], listed=sheet.listed, plays=sheet.plays))
        log_clip(recording, sheet.clips[0])
    else:
        roots = [f"clip_{number}/" for number in range(len(sheet.clips))]
        recording.send_blueprint(beside_blueprint(sheet.clips, roots, plays=sheet.plays))
        for number, (clip, root) in enumerate(zip(sheet.clips, roots, strict=True)):
            log_clip(recording, clip, root=root, beside=number)
    recording.flush()
