"""Where the configuration files are: beside the source in a checkout, else under share/ of the installation."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pred_core.errors import ConfigError

_CHECKOUT = Path(__file__).resolve().parents[1]


def config_folder() -> Path:
    """The folder `config`. Raises: ConfigError if the installation is incomplete."""
    return _find("config", "fastdds.xml")


def sample_dataset() -> Path:
    """The bundled synthetic cable. Raises: ConfigError if the installation is incomplete."""
    return _find("bags/sample_cable", "dataset.yaml")


def sample_pictures() -> Path:
    """The bundled bag of four cameras. Raises: ConfigError if the installation is incomplete."""
    return _find("bags", "sample_cameras.mcap") / "sample_cameras.mcap"


def _find(folder: str, witness: str) -> Path:
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if p]
    shares = [p / "share" / "pred_ros" for p in (*prefixes, Path(sys.prefix))]
    places = [root / folder for root in (_CHECKOUT, *shares)]
    for place in places:
        if (place / witness).is_file():
            return place
    raise ConfigError(f"{folder}/ of this installation is missing", got="nothing in " + ", ".join(map(str, places)))
