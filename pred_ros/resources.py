"""Where the configuration files are: beside the source in a checkout, else under share/ of the installation."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pred_core.errors import ConfigError

_CHECKOUT = Path(__file__).resolve().parents[1]


def config_folder() -> Path:
    """The folder `config`. Raises: ConfigError if the installation is incomplete."""
    places = [_CHECKOUT / "config"]
    places += [
        Path(p) / "share" / "pred_ros" / "config" for p in (os.environ.get("AMENT_PREFIX_PATH") or "").split(":") if p
    ]
    places.append(Path(sys.prefix) / "share" / "pred_ros" / "config")
    for place in places:
        if (place / "fastdds.xml").is_file():
            return place
    raise ConfigError("config/ of this installation is missing", got="nothing in " + ", ".join(map(str, places)))


def fastdds_profile() -> Path:
    """The Fast DDS profile with a large shared-memory segment."""
    return config_folder() / "fastdds.xml"
