"""The grasp: a weld between the tool and one link of the rope, which can open, close, and let the rope slip out."""

from __future__ import annotations

import mujoco
import numpy as np

from pred_core.plant.live.mover import TOOL, matrix_of, quaternion_of_matrix
from pred_core.plant.rope import STEP
from pred_core.plant.world import World

GRASP = "grasp"
REACH = 0.02  # [m] closing jaws take a link this near to the tool centre
# Link axes in the tool: the rope (-z of a link) leaves backwards, along -x of the tool.
TOOL_FROM_LINK = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def add_grasp(spec: mujoco.MjSpec, link: str) -> None:
    """Weld a link of the rope to the tool. Never a child of the tool: it could not slip out."""
    weld = spec.add_equality(name=GRASP, type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    weld.name1, weld.name2 = TOOL, link
    weld.solref = [2.0 * STEP, 1.0]
    weld.solimp = [0.99, 0.999, 0.001, 0.5, 2.0]
    weld.data[:11] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *quaternion_of_matrix(TOOL_FROM_LINK).tolist(), 1.0]


class Jaws:
    """Opens and closes the weld of a compiled world. `closed` is what the jaws report, `holds` is the truth."""

    def __init__(self, world: World):
        self._world = world
        self._weld = int(world.model.equality(GRASP).id)
        self._tool = int(world.model.body(TOOL).id)
        self._first = (int(world.model.eq_obj2id[self._weld]), world.model.eq_data[self._weld].copy())
        self.closed = True

    @property
    def holds(self) -> bool:
        """The rope is in the jaws."""
        return bool(self._world.data.eq_active[self._weld])

    def reset(self) -> None:
        """Hold the rope's end as at first."""
        self._world.model.eq_obj2id[self._weld], self._world.model.eq_data[self._weld] = self._first
        self._world.data.eq_active[self._weld] = 1
        self.closed = True

    def slip(self) -> None:
        """The rope slips out; the jaws stay closed and do not know."""
        self._world.data.eq_active[self._weld] = 0

    def open(self) -> None:
        """Let go."""
        self.slip()
        self.closed = False

    def close(self) -> None:
        """Take the nearest link within REACH as it lies, or nothing."""
        if self.closed and self.holds:
            return
        self.closed = True
        world, data = self._world, self._world.data
        distance = np.linalg.norm(world.position - data.xpos[self._tool], axis=1)
        nearest = int(distance.argmin())
        if distance[nearest] > REACH:
            return
        link = int(world.links[nearest])
        tool = matrix_of(data.xquat[self._tool])
        weld = world.model.eq_data[self._weld]
        weld[3:6] = tool.T @ (data.xpos[link] - data.xpos[self._tool])
        weld[6:10] = quaternion_of_matrix(tool.T @ matrix_of(data.xquat[link]))
        world.model.eq_obj2id[self._weld] = link
        data.eq_active[self._weld] = 1
