"""Where held particles sit in their gripper: what a later recording is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from pred_core.frames import quaternion_conjugate, quaternion_rotate
from pred_core.train.recordings import Recording

Lever = tuple[int, tuple[float, float, float]]


def mean_levers(recordings: Sequence[Recording], ids: Sequence[int]) -> tuple[Lever, ...]:
    """(particle id, lever [m] in its gripper's frame) of the particles that are held, seen, somewhere in `recordings`.

    The median over an episode's frames, then over episodes: one in which the object slides does not count much.
    """
    found: dict[int, list[torch.Tensor]] = {}
    for r in recordings:
        for column in torch.nonzero((r.held >= 0).any(dim=0)).flatten().tolist():
            holder = r.held[:, column].clamp_min(0).long()
            frames = torch.arange(len(holder))
            place, turn = r.grips.position[frames, holder].double(), r.grips.rotation[frames, holder].double()
            lever = quaternion_rotate(quaternion_conjugate(turn), r.position[:, column].double() - place)
            if r.estimated is not None and bool(r.estimated[column]):
                continue
            seen = (r.held[:, column] >= 0) & torch.isfinite(lever).all(dim=-1)
            if seen.any():
                found.setdefault(ids[column], []).append(lever[seen].median(dim=0).values)
    middles = {id: torch.stack(levers).median(dim=0).values.tolist() for id, levers in sorted(found.items())}
    return tuple((id, (x, y, z)) for id, (x, y, z) in middles.items())
