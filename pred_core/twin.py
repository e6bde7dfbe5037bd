"""The Twin: a directory that holds everything known about one object, and the only thing nodes load.

    body.npz                the static object (`Body`)
    physics.yaml            identified scalars (`Physics`), with unit, spread and sensitivity beside each
    calibration.yaml        what sensors and the gripper's pose get wrong, corrected where data enter; absent: nothing
    extensions.yaml         effects that the diagnosis or a user added, by id, with parameters and evidence
    residual.safetensors    network weights, if trained; configuration in its metadata
    twin.yaml               versions, period, scene, hashes of data and parents
    base/                   optional: the plainer twin this one extends, identified by itself, to compare with
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pred_core.calibration import Calibration, calibration_to_mapping, calibration_values
from pred_core.config import from_mapping, load_yaml, setting, to_mapping
from pred_core.errors import TwinError, nearest
from pred_core.types import Body, Box, Capsule, Fixture, ObjectInfo, Physics, Scene, Sphere

FORMAT = 1
MAKE_ONE = "Make one with: pred identify DATASET --out TWIN"
ENTRY = ("id", "version", "parameters", "evidence")  # keys of an entry of extensions.yaml; the last may be left out
_FIXTURES: dict[str, type] = {"box": Box, "capsule": Capsule, "sphere": Sphere}


@dataclass(frozen=True)
class Extension:
    """One effect switched on in a twin. `parameters` are in the units the effect declares."""

    id: str
    version: int
    parameters: Mapping[str, tuple[float, ...]]  # scalars are 1-tuples
    evidence: Mapping[str, Any] = field(default_factory=dict)  # how it was found; `pred evaluate` reads its `found_by`
    source: str = field(default="", compare=False, repr=False)  # the file it was read from, which a message names


@dataclass(frozen=True)
class ResidualWeights:
    """A trained residual network as stored: its configuration and its tensors."""

    config: Mapping[str, Any]
    tensors: Mapping[str, Tensor]


@dataclass(frozen=True)
class TwinMeta:
    """`twin.yaml`."""

    format: int = setting(FORMAT, doc="version of this layout")
    object: ObjectInfo = ObjectInfo()
    period: float = setting(0.01, unit="s", low=1e-4, high=1.0, doc="time one step covers")
    substeps: int | None = setting(None, low=1, high=100_000, doc="simulator substeps a period; absent: by stability")
    held: tuple[tuple[int, int], ...] = setting((), doc="(particle id, gripper) pairs held at the start, if fixed")
    levers: tuple[tuple[int, tuple[float, float, float]], ...] = setting(
        (), unit="m", doc="(particle id, mean place in its gripper's frame) of particles that were held"
    )
    created_by: str = setting("", doc="the command line that wrote it")
    data: tuple[str, ...] = setting((), doc="sha256 of every bag it was fitted on")
    parent: str = setting("", doc="hash of the twin this one extends")
    notes: tuple[str, ...] = setting((), doc="what the user should know, e.g. 'mass is nominal'")


@dataclass(frozen=True)
class Twin:
    """See the module. Immutable: `replace` and `save` make another."""

    meta: TwinMeta
    body: Body
    physics: Physics
    scene: Scene = Scene()
    extensions: tuple[Extension, ...] = ()
    residual: ResidualWeights | None = None
    physics_report: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # per parameter: spread, ...
    base: Twin | None = None  # the plainer twin this one extends
    calibration: Calibration = Calibration()  # of the data this twin is used on

    def replace(self, **changes: Any) -> Twin:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def save(self, path: Path) -> None:
        """Write the directory (made if missing); files of another twin there are overwritten."""
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        arrays = {f.name: getattr(self.body, f.name) for f in dataclasses.fields(self.body)}
        np.savez_compressed(path / "body.npz", **arrays)
        physics = {
            f.name: {
                "value": getattr(self.physics, f.name),
                "unit": f.metadata.get("unit", ""),
                **dict(self.physics_report.get(f.name, {})),
            }
            for f in dataclasses.fields(self.physics)
        }
        _write_yaml(path / "physics.yaml", physics)
        _write_yaml(
            path / "extensions.yaml",
            [
                {
                    "id": e.id,
                    "version": e.version,
                    "parameters": {k: list(v) for k, v in e.parameters.items()},
                    "evidence": dict(e.evidence),
                }
                for e in self.extensions
            ],
        )
        if self.calibration.identity:
            (path / "calibration.yaml").unlink(missing_ok=True)
        else:
            _write_yaml(path / "calibration.yaml", calibration_to_mapping(self.calibration))
        meta = to_mapping(self.meta)
        meta["scene"] = _scene_to_mapping(self.scene)
        _write_yaml(path / "twin.yaml", meta)
        if self.base is not None:
            self.base.replace(base=None).save(path / "base")
        elif (path / "base").is_dir():
            shutil.rmtree(path / "base")
        weights = path / "residual.safetensors"
        if self.residual is None:
            weights.unlink(missing_ok=True)
        else:
            tensors = {k: v.detach().cpu().contiguous() for k, v in self.residual.tensors.items()}
            save_file(tensors, weights, metadata={"config": json.dumps(dict(self.residual.config))})

    @classmethod
    def load(cls, path: Path) -> Twin:
        """Read a twin directory. Raises: TwinError or ConfigError naming the file and the key."""
        path = Path(path)
        for name in ("twin.yaml", "body.npz", "physics.yaml", "extensions.yaml"):
            if not (path / name).is_file():
                raise TwinError(
                    f"{path}: not a twin, '{name}' is missing",
                    got=", ".join(sorted(p.name for p in path.iterdir())[:8]) if path.is_dir() else "no such directory",
                    next_step="An empty list, [], means no effects" if name == "extensions.yaml" else MAKE_ONE,
                )
        meta_map = dict(load_yaml(path / "twin.yaml") or {})
        if meta_map.get("format") != FORMAT:
            raise TwinError(
                f"{path}/twin.yaml: format", got=meta_map.get("format"), allowed=FORMAT,
                next_step="Write the twin again with this version",
            )
        scene = _scene_from_mapping(meta_map.pop("scene", {}), f"{path}/twin.yaml: scene")
        entries = load_yaml(path / "physics.yaml") or {}
        try:
            values = {k: v["value"] for k, v in entries.items()}
        except (TypeError, KeyError, AttributeError) as error:
            raise TwinError(f"{path}/physics.yaml: each parameter needs a 'value'", got=error) from error
        lacking = [f.name for f in dataclasses.fields(Physics) if f.name not in values]
        if lacking and values.keys() <= {f.name for f in dataclasses.fields(Physics)}:  # else a name is misspelt
            raise TwinError(
                f"{path}/physics.yaml: parameters are missing", got=", ".join(values) or "none",
                allowed=f"{', '.join(lacking)} too, each with a 'value'", next_step="Identify the twin again",
            )  # fmt: skip
        report = {k: {a: b for a, b in v.items() if a not in ("value", "unit")} for k, v in entries.items()}
        return cls(
            meta=from_mapping(TwinMeta, meta_map, f"{path}/twin.yaml"),
            body=_load_body(path / "body.npz"),
            physics=from_mapping(Physics, values, f"{path}/physics.yaml"),
            scene=scene,
            extensions=_load_extensions(path / "extensions.yaml"),
            residual=_load_residual(path / "residual.safetensors"),
            physics_report=report,
            base=cls.load(path / "base") if (path / "base").is_dir() else None,
            calibration=_load_calibration(path / "calibration.yaml"),
        )

    def digest(self) -> str:
        """sha256 over everything that changes a prediction; stored as `parent` by what extends this twin."""
        sha = hashlib.sha256()
        for f in dataclasses.fields(self.body):
            sha.update(np.ascontiguousarray(getattr(self.body, f.name)).tobytes())
        extensions = [(e.id, e.version, sorted(e.parameters.items())) for e in self.extensions]
        sha.update(repr((self.physics, self.scene, extensions, self.meta.period, self.meta.substeps)).encode())
        if not self.calibration.identity:
            sha.update(repr(self.calibration).encode())
        if self.residual is not None:
            for key in sorted(self.residual.tensors):
                sha.update(self.residual.tensors[key].detach().cpu().contiguous().numpy().tobytes())
        return sha.hexdigest()


def _load_body(path: Path) -> Body:
    try:
        with np.load(path, allow_pickle=False) as data:
            missing = [f.name for f in dataclasses.fields(Body) if f.name not in data.files]
            if missing:
                raise TwinError(f"{path}: arrays are missing", got=", ".join(data.files), allowed=", ".join(missing))
            arrays = {f.name: data[f.name] for f in dataclasses.fields(Body)}
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, zlib.error, zipfile.BadZipFile) as error:
        if isinstance(error, TwinError):
            raise
        raise TwinError(f"{path}: cannot be read", got=error, next_step="Identify the twin again") from error
    arrays["kind"], arrays["radius"] = str(arrays["kind"]), float(arrays["radius"])
    body = Body(**arrays)  # type: ignore[arg-type]
    for f in dataclasses.fields(body):
        value = getattr(body, f.name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
            raise TwinError(f"{path}: '{f.name}' is not finite", next_step="Identify the twin again")
    return body


def _load_extensions(path: Path) -> tuple[Extension, ...]:
    entries = load_yaml(path) or []
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise TwinError(f"{path}: not a list of entries", allowed=f"each with {', '.join(ENTRY)}")
    try:
        found = tuple(_extension(e, f"{path}: entry {n}", str(path)) for n, e in enumerate(entries, 1))
    except (TypeError, KeyError, AttributeError) as error:
        raise TwinError(f"{path}: malformed entry", got=error, allowed=", ".join(ENTRY)) from error
    ids = [e.id for e in found]
    for id in ids:
        if ids.count(id) > 1:
            raise TwinError(f"{path}: '{id}' is listed twice", allowed="each once", next_step="Remove one of them")
    return found


def _extension(entry: Mapping[str, Any], where: str, file: str) -> Extension:
    """One entry, strictly; whether the effect exists and its values fit is for the effects to say (`effect_of`)."""
    for key in entry:
        if key not in ENTRY:
            raise TwinError(f"{where}: unknown key '{key}'", next_step=nearest(str(key), ENTRY))
    for key in ENTRY[:3]:
        if key not in entry:
            raise TwinError(f"{where}: missing key '{key}'", allowed=", ".join(ENTRY))
    id, version = entry["id"], entry["version"]
    if not isinstance(id, str):
        raise TwinError(f"{where}: id", got=repr(id), allowed="the name of an effect")
    if type(version) is not int:
        raise TwinError(f"{where}: version", got=repr(version), allowed="a whole number")
    parameters = {}
    for name, values in entry["parameters"].items():
        if not isinstance(values, list) or not all(type(v) in (int, float) for v in values):
            raise TwinError(f"{where}: '{name}' of {id}", got=repr(values), allowed="a list of numbers, such as [0.5]")
        parameters[name] = tuple(float(v) for v in values)
    return Extension(id, version, parameters, entry.get("evidence") or {}, file)


def _load_calibration(path: Path) -> Calibration:
    if not path.is_file():
        return Calibration()
    return from_mapping(Calibration, calibration_values(load_yaml(path) or {}, str(path)), str(path))


def _load_residual(path: Path) -> ResidualWeights | None:
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            config = json.loads((file.metadata() or {})["config"])
            return ResidualWeights(config, {k: file.get_tensor(k) for k in file.keys()})  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, json.JSONDecodeError) as error:
        raise TwinError(f"{path}: not residual weights of this project", got=error) from error


def _scene_to_mapping(scene: Scene) -> dict[str, Any]:
    plain: dict[str, Any] = {
        "gravity": list(scene.gravity),
        "ground": scene.ground,
        "pusher_radius": scene.pusher_radius,
        "grasp_radius": scene.grasp_radius,
        "fixtures": [],
    }
    names = {cls: name for name, cls in _FIXTURES.items()}
    for fixture in scene.fixtures:
        plain["fixtures"].append({"shape": names[type(fixture)], **to_mapping(fixture)})
    return plain


def _scene_from_mapping(values: Mapping[str, Any], source: str) -> Scene:
    values = dict(values)
    fixtures: list[Fixture] = []
    for i, entry in enumerate(values.pop("fixtures", []) or []):
        entry = dict(entry)
        shape = entry.pop("shape", None)
        if shape not in _FIXTURES:
            raise TwinError(f"{source}: fixtures[{i}].shape", got=shape, allowed=", ".join(_FIXTURES))
        fixtures.append(from_mapping(_FIXTURES[shape], entry, f"{source}: fixtures[{i}]"))
    scene = from_mapping(Scene, values, source)
    return dataclasses.replace(scene, fixtures=tuple(fixtures))


def _write_yaml(path: Path, value: Any) -> None:
    path.write_text(yaml.safe_dump(value, sort_keys=False, allow_unicode=True), encoding="utf-8")
