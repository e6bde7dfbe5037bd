"""The form of a law: one with a free power is the same where the power is the law's, and tells another power from it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from springmass_cases import holding, line, still, state_of, zigzag

from pred_core.effects import LIBRARY
from pred_core.springmass import SpringMass
from pred_core.springmass.reference import Reference
from pred_core.twin import Extension
from pred_core.types import Physics, Scene

ON = {"drag_linear": 1.7, "drag_quadratic": 2.3, "friction_scale": 0.8, "friction_viscous": 4.0}
OF_A_FORM = sorted(id for id, effect in LIBRARY.items() if effect.form)


@pytest.mark.parametrize("id", OF_A_FORM)
@pytest.mark.parametrize("simulator", [SpringMass, Reference])
def test_a_law_written_in_its_form_is_the_same_law(id: str, simulator: type[SpringMass] | type[Reference]) -> None:
    effect, physics = LIBRARY[id], Physics(stiffness=60.0, damping=0.1, ground_friction=0.4)
    law = effect.extension(**{effect.parameters[0].name: ON[id]})
    same = Extension(effect.form, 1, effect.in_form(law.parameters, physics))
    ends = []
    for extensions in ([law], [same], []):
        start = zigzag(13, 0.05, 40.0) + np.array([0.0, 0.0, 0.01])
        sim = simulator(line(13, 0.6), physics, Scene(ground=0.0), extensions=extensions, substeps=20)
        state = sim.start(state_of(start, torch.full((13, 3), 0.6)), still(torch.tensor(start[:1], dtype=torch.float32)))
        x, _ = sim.rollout_states(state, still(torch.tensor(start[:1], dtype=torch.float32), 30))
        ends.append(x[-1])
    assert float((ends[0] - ends[2]).abs().max()) > 1e-3, "the law does nothing here"
    assert float((ends[0] - ends[1]).abs().max()) < 1e-5
