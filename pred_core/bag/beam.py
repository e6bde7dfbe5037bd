"""The soft beam of srl-ethz/diffPD_sim2real (MIT): a clamped silicone beam let go, with and without a load at its tip.

The file has six markers: three on the tip, three on the clamp. The beam is described as a line along its axis:
particle 0 and 1 in the clamp, the last two on the tip, those between never measured (`bag/unseen.py` says where they
are at a start). Its last particle is the centre of the three tip markers, the one before it lies one edge behind it
and turns with them. In the clamp, the middle of the held edge lies in the plane of the clamp's markers (their mean over
all takes, which differ by 0.5 mm): the bend at its far end stands for the beam from there on.

Axes: the file's up is x and the beam lies along z. World (x, y, z) = file (y, z, x), a rotation; so up is z, and the
beam points along y. Gravity is -z, as the sag shows, to a few degrees.

Before a take's release a hand holds the tip up, and a little to the side. The beam is taken to be level there, and
straight seen from above when it has come to rest: this says where its axis is in the tip. It is released over several
frames during which the hand still touches it; what is written begins 0.2 s later. A take is one episode: cut into
seconds, all but the first would show a beam at rest.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pred_core.bag.dataset import Dataset, EpisodeEntry, file_sha256, write_dataset
from pred_core.bag.deform import FIRST_STAMP, Progress, claim_folder
from pred_core.bag.episode import write_episode
from pred_core.bag.unseen import KEY
from pred_core.errors import DatasetError
from pred_core.types import Array, Episode, Grip, ObjectInfo, Tracks

RATE = 100.0  # [Hz] motion capture
SIGMA = 0.000003  # [m] of the centre and the direction of three markers, each 0.002 to 0.009 mm
PARTICLES = 8
WORLD_FROM_FILE = [1, 2, 0]  # world axes x, y, z are these axes of the file
CLAMP_ROTATION = (0.5**0.5, 0.0, 0.0, 0.5**0.5)  # wxyz: the gripper's x along the beam, its y across, as of jaws
MARKERS = ("Tip - 1", "Tip - 2", "Tip - 3", "Base - 1", "Base - 2", "Base - 3")
STILL = 10  # frames at the beginning of a take in which the beam is held
RELEASED = 0.00005  # [m] by which the tip has dropped when it is let go
HANDS_OFF = 20  # frames after that in which the hand may still touch it
SETTLED = 50  # frames at the end of a take in which it rests
LEAST = 100  # frames an episode must have
SPLITS = ("train", "test")  # first take, second take
_NAME = re.compile(r"beam_(?:gravity|load(\d+))_.+")


@dataclass(frozen=True)
class Take:
    """One release: tip markers (T, 3, 3) [m] and the centre of the clamp's markers (3,) [m], both world."""

    name: str
    tip: Array
    base: Array


@dataclass(frozen=True)
class BeamSource:
    """The takes with one load."""

    load: int  # [g]
    takes: tuple[Take, ...]
    edge: float  # [m] between particles, the same for all takes of the file: it is one beam
    digest: str


def read_beam(path: Path | str, load: int) -> BeamSource:
    """The takes of soft_beam.npz with `load` [g] at the tip. Raises: DatasetError."""
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
    except (OSError, EOFError, ValueError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise DatasetError(f"{path}: not an npz file", got=error, next_step="Give soft_beam.npz") from error
    loads = {name: int(found[1] or 0) for name in arrays if (found := _NAME.fullmatch(name)) and "__" not in name}
    if not loads:
        wanted = "beam_gravity_*, beam_load52_*"
        raise DatasetError(f"{path}: no takes of a beam", got=", ".join(arrays), allowed=wanted)
    known = ", ".join(str(g) for g in sorted(set(loads.values())))
    if load not in loads.values():
        raise DatasetError(f"{path}: no take with this load", got=f"{load} g", allowed=f"{known} g")
    hz = float(arrays["hz"]) if "hz" in arrays and arrays["hz"].ndim == 0 else float("nan")
    if hz != RATE:
        raise DatasetError(f"{path}: hz", got=hz, allowed=RATE)
    takes = {name: _take(name, arrays[name], arrays.get(f"{name}__markers"), path) for name in loads}
    length = float(np.mean([t.tip[:STILL].mean(axis=(0, 1))[1] - t.base[1] for t in takes.values()]))
    chosen = tuple(t for name, t in takes.items() if loads[name] == load)
    return BeamSource(load, chosen, length / (PARTICLES - 1.5), file_sha256(path))


def convert_beam(source: BeamSource, root: Path, progress: Progress) -> Dataset:
    """Write each take as one episode, and `dataset.yaml`. The first take is `train`, the others `test`.

    Raises: DatasetError if `root` holds something else.
    """
    claim_folder(root, {"source": f"soft_beam load {source.load} g", "sha256": source.digest, "format": 1})
    entries = []
    for n, take in enumerate(source.takes):
        bag = f"{take.name}.mcap"
        entries.append(EpisodeEntry(bag, SPLITS[min(n, 1)], n))
        if not (root / bag).exists():
            write_episode(root / bag, beam_episode(source, n))
        progress(n + 1, len(source.takes), bag)
    return write_dataset(
        root,
        object=ObjectInfo("soft_beam", "line"),
        rate=RATE,
        entries=entries,
        sigma=SIGMA,
        held={0: 0, 1: 0},
        known={KEY: [round(source.edge, 7)] * (PARTICLES - 1)},
    )


def first_frame(take: Take) -> int:
    """The first frame that nothing but the clamp and gravity touches. Raises: DatasetError if there is no release."""
    height = take.tip.mean(axis=1)[:, 2]
    dropped = height < height[:STILL].mean() - RELEASED
    # The last frame at the held height: a hand that is about to let go shakes the tip, but does not drop it.
    release = 0 if dropped.all() else len(dropped) - int(np.argmin(dropped[::-1]))
    begin = release + HANDS_OFF
    if not dropped[-1] or len(height) < begin + LEAST:
        raise DatasetError(f"{take.name}: no release with {LEAST} frames after it", got=f"{len(height)} frames")
    return begin


def beam_episode(source: BeamSource, index: int) -> Episode:
    """One take. The clamp is a gripper that stands still; particles between clamp and tip are hidden."""
    take = source.takes[index]
    begin = first_frame(take)
    tip = take.tip[begin:]
    count = len(tip)
    position = np.zeros((count, PARTICLES, 3))
    position[:, -1] = tip.mean(axis=1)
    position[:, -2] = position[:, -1] - source.edge * tip_direction(take)[begin:]
    clamp = take.tip[:STILL].mean(axis=(0, 1))
    clamp[0] = take.tip[-SETTLED:].mean(axis=(0, 1))[0]
    clamp[1] -= source.edge * (PARTICLES - 1.5)
    half = np.array([0.0, 0.5 * source.edge, 0.0])
    position[:, 0], position[:, 1] = clamp - half, clamp + half
    seen = np.zeros((count, PARTICLES), bool)
    seen[:, [0, 1, -2, -1]] = True
    held = np.full(PARTICLES, -1, np.int32)
    held[:2] = 0
    stamps = FIRST_STAMP + (begin + np.arange(count, dtype=np.int64)) * round(1e9 / RATE)
    return Episode(
        name=take.name,
        object=ObjectInfo("soft_beam", "line"),
        stamps=stamps,
        tracks=Tracks(stamps, position, np.arange(PARTICLES, dtype=np.uint32), seen, seen.astype(np.float32)),
        grips=Grip(
            position=torch.as_tensor(clamp, dtype=torch.float32).expand(count, 1, 3).contiguous(),
            rotation=torch.tensor(CLAMP_ROTATION).expand(count, 1, 4).contiguous(),
            closed=torch.ones(count, 1, dtype=torch.bool),
        ),
        held=held,
        split=SPLITS[min(index, 1)],
        recording=index,
    )


def tip_direction(take: Take) -> Array:
    """(T, 3) the axis at the tip, fixed to its three markers: level while the beam is held, along y seen from above
    when it has come to rest.

    The rotation is the least-squares one between the triangles (Kabsch 1976).
    """
    held = take.tip[:STILL].mean(axis=0)
    a = held - held.mean(axis=0)
    b = take.tip - take.tip.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("mi,tmj->tij", a, b))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotation = np.swapaxes(u @ vt, 1, 2)  # (T, 3, 3), now from held
    rest = rotation[-SETTLED:].mean(axis=0)
    axis = np.array([-rest[0, 1] / rest[0, 0], 1.0, 0.0])
    return np.asarray(rotation @ (axis / np.linalg.norm(axis)))


def _take(name: str, position: NDArray[np.float32], markers: NDArray[np.str_] | None, path: Path) -> Take:
    if markers is None or tuple(markers.tolist()) != MARKERS:
        got = "no names" if markers is None else ", ".join(map(str, markers.tolist()))
        raise DatasetError(f"{path}: markers of {name}", got=got, allowed=", ".join(MARKERS))
    shape = position.shape
    if position.dtype.kind != "f" or len(shape) != 3 or shape[1:] != (6, 3) or not np.isfinite(position).all():
        raise DatasetError(f"{path}: {name}", got=shape, allowed="(frames, 6 markers, 3) finite floats [m]")
    world = position.astype(np.float64)[:, :, WORLD_FROM_FILE]
    return Take(name, world[:, :3], np.median(world[:, 3:], axis=0).mean(axis=0))
