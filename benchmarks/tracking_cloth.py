"""A patterned cloth in MuJoCo, held along its upper edge and swung, with exact truth for the tracking benchmark."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from pred_core.plant.appearance import cover, dress_spec, speckled_picture
from pred_core.plant.rope import STEP
from pred_core.types import Array

WIDE, HIGH, SPACING = 17, 13, 0.025  # vertices, vertices, [m]
MIDDLE = 0.45  # [m] height of the cloth's middle
XML = f"""
<mujoco>
  <option timestep="{STEP}" integrator="discrete" solver="CG" iterations="100"/>
  <worldbody>
    <geom name="table" type="plane" size="3 3 0.1"/>
    <flexcomp name="cloth" type="grid" dim="2" count="{WIDE} {HIGH} 1" spacing="{SPACING} {SPACING} {SPACING}"
      pos="0 0 {MIDDLE}" euler="90 0 0" mass="0.03" radius="0.002" material="print">
      <contact selfcollide="none"/>
      <elasticity young="3e4" poisson="0.2" thickness="1e-3" damping="1e-3" elastic2d="both"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


class Cloth:
    """40 cm x 30 cm, 30 g, 221 vertices; the upper edge is moved as told."""

    def __init__(self, speed: float, seed: int):
        """`speed` [m/s] is the largest of the held edge."""
        spec = mujoco.MjSpec.from_string(XML)
        dress_spec(spec)
        cover(
            spec, "print", speckled_picture(np.random.default_rng(seed), (0.8, 0.2, 0.25), 512, 10), 1.0, uniform=False
        )
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        rest = self.data.flexvert_xpos.copy()
        top = np.flatnonzero(rest[:, 2] > rest[:, 2].max() - 1e-6)
        self._dof = (3 * top[:, None] + np.arange(3)).astype(int)
        self._start = self.data.qpos[self._dof].copy()
        self.speed, self.time = speed, 0.0

    @property
    def vertices(self) -> Array:
        """(221, 3) [m] world, truth."""
        return self.data.flexvert_xpos.copy()

    def step(self) -> None:
        """One MuJoCo step."""
        self.time += STEP
        after, before = self._shift(self.time), self._shift(self.time - STEP)
        self.data.qpos[self._dof] = self._start + before
        self.data.qvel[self._dof] = (after - before) / STEP
        mujoco.mj_step(self.model, self.data)

    def _shift(self, time: float) -> Array:
        """(3,) [m] of the upper edge; it starts from rest."""
        rise = min(time, 1.0) ** 2
        swing = np.array([0.6 * np.sin(1.3 * time), np.sin(2.0 * time), 0.3 * np.sin(0.9 * time)])
        return rise * self.speed / 2.0 * swing


class OnCloth:
    """Material points of the cloth bound to where particles were first seen."""

    def __init__(self, position: Array, vertices: Array):
        """Nearest points of the mesh to particles (P, 3) [m]; inside each square cell, bilinear."""
        grid = vertices.reshape(WIDE, HIGH, 3)
        fine = np.linspace(0.0, 1.0, 9)
        cells, shares, places = [], [], []
        for i in range(WIDE - 1):
            for j in range(HIGH - 1):
                for a in fine:
                    for b in fine:
                        w = np.array([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
                        corner = np.array([[i, j], [i, j + 1], [i + 1, j], [i + 1, j + 1]])
                        cells.append(corner[:, 0] * HIGH + corner[:, 1])
                        shares.append(w)
                        places.append(w @ grid[corner[:, 0], corner[:, 1]])
        nearest = cKDTree(np.array(places)).query(position)[1]
        self._corner, self._share = np.array(cells)[nearest], np.array(shares)[nearest]

    def at(self, vertices: Array) -> Array:
        """(P, 3) [m] of the same material points when the mesh is at `vertices`."""
        return np.asarray(np.einsum("pc,pca->pa", self._share, vertices[self._corner]))
