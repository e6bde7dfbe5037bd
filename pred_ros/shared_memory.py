"""What Fast DDS leaves in shared memory when a process is killed: 35 MB a node with our profile, for ever.

A node that ends by itself leaves nothing; a killed one cannot clean up. The same rule as `fastdds shm clean`: the
owner of a segment NAME holds a lock on NAME_el while it lives, so whoever gets that lock may remove both.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
_LOCK = "_el"


def sweep(folder: Path = SHARED_MEMORY) -> int:
    """Remove the segments of participants that have died; those of living ones and of other users stay.

    Returns: number of segments removed.
    """
    locks = [p for p in folder.glob(f"fastrtps_*{_LOCK}") if not p.name.startswith("fastrtps_port")]
    return sum(_removed(p) for p in locks)


def _removed(lock: Path) -> bool:
    try:
        handle = os.open(lock, os.O_RDONLY)
    except OSError:  # gone in the meantime, or another user's
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        segment = lock.with_name(lock.name.removesuffix(_LOCK))
        with contextlib.suppress(FileNotFoundError):
            segment.unlink()
        lock.unlink()
    except OSError:  # its owner lives, or we may not
        return False
    finally:
        os.close(handle)
    return True
