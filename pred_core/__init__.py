"""Track, predict, diagnose and drive soft objects: the plain Python core.

The public names below are imported from their modules when first used, so that `import pred_core` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pred_core.bag.dataset import Dataset, load_dataset, write_dataset
    from pred_core.bag.episode import read_episode, write_episode
    from pred_core.bag.reader import open_bag
    from pred_core.bag.writer import BagWriter
    from pred_core.dynamics import Dynamics, rollout_by_steps
    from pred_core.effects import LIBRARY, find_effect
    from pred_core.effects.effect import Effect
    from pred_core.errors import PredError
    from pred_core.evaluate.protocol import predict
    from pred_core.identify.config import IdentifyConfig
    from pred_core.pred import PReD, load_dynamics
    from pred_core.residual import ResidualConfig, ResidualNetwork
    from pred_core.springmass import SpringMass, build_body
    from pred_core.twin import Extension, Twin
    from pred_core.types import Body, Episode, Grip, Physics, Scene, State, Tracks

_HOME = {
    "pred_core.bag.dataset": ("Dataset", "load_dataset", "write_dataset"),
    "pred_core.bag.episode": ("read_episode", "write_episode"),
    "pred_core.bag.reader": ("open_bag",),
    "pred_core.bag.writer": ("BagWriter",),
    "pred_core.dynamics": ("Dynamics", "rollout_by_steps"),
    "pred_core.effects": ("LIBRARY", "find_effect"),
    "pred_core.effects.effect": ("Effect",),
    "pred_core.errors": ("PredError",),
    "pred_core.evaluate.protocol": ("predict",),
    "pred_core.identify.config": ("IdentifyConfig",),
    "pred_core.pred": ("PReD", "load_dynamics"),
    "pred_core.residual": ("ResidualConfig", "ResidualNetwork"),
    "pred_core.springmass": ("SpringMass", "build_body"),
    "pred_core.twin": ("Extension", "Twin"),
    "pred_core.types": ("Body", "Episode", "Grip", "Physics", "Scene", "State", "Tracks"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "LIBRARY",
    "BagWriter",
    "Body",
    "Dataset",
    "Dynamics",
    "Effect",
    "Episode",
    "Extension",
    "Grip",
    "IdentifyConfig",
    "PReD",
    "Physics",
    "PredError",
    "ResidualConfig",
    "ResidualNetwork",
    "Scene",
    "SpringMass",
    "State",
    "Tracks",
    "Twin",
    "build_body",
    "find_effect",
    "load_dataset",
    "load_dynamics",
    "open_bag",
    "predict",
    "read_episode",
    "rollout_by_steps",
    "write_dataset",
    "write_episode",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"pred_core has no '{name}'")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
