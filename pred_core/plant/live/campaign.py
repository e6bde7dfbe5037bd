"""A data set recorded in the cell: plan, seeds, resumption. The tracker comes from outside."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pred_core.bag.dataset import Dataset, EpisodeEntry, write_dataset
from pred_core.bag.deform import claim_folder
from pred_core.config import setting, to_mapping
from pred_core.errors import ConfigError
from pred_core.plant.cameras import ring_of_cameras
from pred_core.plant.live.cell import WORKPLACE, Cell, CellConfig
from pred_core.plant.live.collect import Keeping, Watcher, record
from pred_core.plant.live.slot import SlotConfig
from pred_core.plant.live.station import Station
from pred_core.plant.live.teleop import draw_route
from pred_core.types import ObjectInfo

Progress = Callable[[int, int, str], None]  # done, total, name
MakeWatcher = Callable[[Cell], Watcher]
HELD = {0: 0, 1: 0}  # the two points in the jaws


@dataclass(frozen=True)
class CampaignConfig:
    """How many episodes of which family; the slot's are out of distribution: their twin knows no posts."""

    train: int = setting(12, low=0, high=1000, doc="episodes over the table, to fit on")
    test: int = setting(4, low=0, high=1000, doc="episodes over the table")
    slot: int = setting(4, low=0, high=1000, doc="episodes over the slot and back, split ood")
    seconds: float = setting(8.0, unit="s", low=1.0, high=60.0, doc="of an episode")
    rate: float = setting(15.0, unit="Hz", low=1.0, high=30.0, doc="of cameras and tracks; must divide 150")
    seed: int = setting(0, low=0, high=2**31 - 1, doc="starts and motions")
    pictures: bool = setting(False, doc="keep the pictures in the bags, compressed")


def collect(
    root: Path,
    make_watcher: MakeWatcher,
    progress: Progress,
    campaign: CampaignConfig | None = None,
    cell: CellConfig | None = None,
    gap: float = SlotConfig.gap,
    measured: Mapping[str, float] | None = None,
) -> Dataset:
    """Record the episodes that are not there yet, then write dataset.yaml.

    measured: what a person finds out with scale and caliper (mass [kg], radius [m]); it goes into `known` beside the
    height of the table, which is the rig's. Nothing else is said of the object.

    Raises: ConfigError for a rate that is no whole number of ticks; DatasetError if `root` holds something else;
    InputError if the tracker sees the rope too rarely.
    """
    campaign, cell = campaign or CampaignConfig(), cell or CellConfig()
    if abs(150.0 / campaign.rate - round(150.0 / campaign.rate)) > 1e-6:
        raise ConfigError("rate", got=f"{campaign.rate} Hz", allowed="150 / n Hz: 30, 25, 15, 10, ...")
    plan = (
        [("train", "table")] * campaign.train + [("test", "table")] * campaign.test + [("ood", "slot")] * campaign.slot
    )
    if not plan:
        raise ConfigError("episodes", got="0 0 0", allowed="at least one")
    about = {
        "source": "cell",
        "synthetic": True,
        "campaign": to_mapping(campaign),
        "cell": to_mapping(cell),
        "gap": gap,
    }
    claim_folder(root, {**about, "format": 1})
    cameras = tuple(dataclasses.replace(c, rate=campaign.rate) for c in ring_of_cameras(target=WORKPLACE))
    with Cell(cell, slot=SlotConfig(gap=gap), cameras=cameras) as made:
        for number, (_, family) in enumerate(plan):
            path = root / f"ep{number:03d}.mcap"
            if not path.exists():
                station = Station(made)  # its stamps do not depend on what was recorded before
                station.reset(campaign.seed * 10_000 + number)
                generator = np.random.default_rng([campaign.seed, 10, number])
                route = draw_route(generator, family, made.reference, made.slot, campaign.seconds)
                keeping = Keeping() if campaign.pictures else None
                record(path, station, route, campaign.seconds, make_watcher(made), keeping)
            progress(number + 1, len(plan), path.stem)
    entries = [EpisodeEntry(f"ep{n:03d}.mcap", split, n) for n, (split, _) in enumerate(plan)]
    known = {"ground": 0.0, **(measured or {})}
    return write_dataset(
        root, object=ObjectInfo("rope", "line"), rate=campaign.rate, entries=entries, held=HELD, known=known
    )
