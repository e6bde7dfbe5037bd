"""Builds the native Warp kernel for a set of effects: traces their laws and fills the source's placeholders."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import warp as wp

from pred_core.effects.effect import Effect
from pred_core.springmass import source, source_bending, source_contact
from pred_core.springmass.laws import BASE_PARAMETERS, end_twist, law_statements

SIMD_LANES = 16  # worlds side by side on CPU
FEW_WORLDS = 4  # fewer run one after the other, eight springs side by side: quicker than sixteen lanes
wp.config.log_level = 30


@wp.struct
class Model:
    """What all worlds share; see `source.PRELUDE` for shapes."""

    springs: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    spring_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    bends: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    bend_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    particle_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    fixture_shape: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    fixture_data: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    pairs: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    held: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    chains: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    particles: wp.int32
    spring_count: wp.int32
    bend_count: wp.int32
    grippers: wp.int32
    held_count: wp.int32
    fixture_count: wp.int32
    pair_count: wp.int32
    chain_count: wp.int32
    blocks: wp.int32
    parameter_count: wp.int32
    memory_count: wp.int32
    periods: wp.int32
    substeps: wp.int32
    masked: wp.int32
    has_ground: wp.int32
    loose: wp.int32  # some line is held at neither end
    stage: wp.int32
    stage_sub: wp.int32
    substep: wp.float32  # [s]
    inverse_substeps: wp.float32
    inverse_period: wp.float32  # [1/s]
    gravity_x: wp.float32
    gravity_y: wp.float32
    gravity_z: wp.float32
    ground: wp.float32  # [m]
    radius: wp.float32  # [m] particle
    pusher_radius: wp.float32  # [m]
    contact_distance: wp.float32  # [m]


@wp.struct
class Worlds:
    """What each world has of its own; innermost axis is the lane."""

    position: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    velocity: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    force: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    mass: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    inverse_mass: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    parameters: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    spring_mask: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_mask: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_offset: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    held_lever: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    grips: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    frame_grip: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    memory: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    load: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    tangent: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    time: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    steps: wp.array(dtype=wp.float32)  # type: ignore[valid-type]
    clock: wp.array(dtype=wp.int32)  # type: ignore[valid-type]
    trajectory_out: wp.array(dtype=wp.float32)  # type: ignore[valid-type]


def parameter_count(effects: tuple[type[Effect], ...]) -> int:
    """Length of a world's parameter row: the base ones, then each effect's in order."""
    return BASE_PARAMETERS + sum(q.size for e in effects for q in e.parameters)


def stride(lanes: int, staged: bool) -> int:
    """Floats a particle takes per lane: four where one world runs eight springs at a time, else three."""
    return 4 if lanes == 1 and not staged else 3


def kernel_text(effects: tuple[type[Effect], ...], lanes: int, staged: bool) -> str:
    """The C++ of the native function, every placeholder filled."""
    framed = any("bend" in e.hooks for e in effects)
    grips = sum(e.grip_memory for e in effects)
    tangents = any(e.reads_tangent for e in effects)
    eight = stride(lanes, staged) == 4
    text = "\n".join(
        (source.PRELUDE, source_bending.TANGENT_BUFFER if tangents else "", source_bending.FRAME if framed else "",
         source.SPRING, source.SPRING_EIGHT if eight else "", source_bending.BEND, source_contact.CONTACT,
         source_contact.SELF_COLLISION, source_contact.GRIP_MEMORY if grips else "", source_contact.PARTICLE,
         source_contact.HELD, source.STAGED if staged else source.FUSED)
    )  # fmt: skip
    parts = {
        "@SPRING_LAW@": source.SPRING_LAW,
        "@VECTOR_FUNCTIONS@": source.VECTOR_FUNCTIONS,
        "@SCALAR@": "1" if lanes == 1 else "0",
        "@LANES@": str(lanes),
        "@STRIDE@": str(stride(lanes, staged)),
        "@ALL_SPRINGS@": source.ALL_SPRINGS_EIGHT if eight else source.ALL_SPRINGS,
        "@ALL_BENDS@": source_bending.ALL_BENDS_FRAMED if framed else source_bending.ALL_BENDS,
        "@ONE_BEND@": source_bending.ONE_BEND_FRAMED if framed else source_bending.ONE_BEND,
        "@TANGENT@": source_bending.TANGENT if tangents else "",
        "@BEND_FRAME@": source_bending.BEND_FRAME if framed else "",
        "@BEND_MOMENT@": source_bending.BEND_MOMENT if framed else "",
        "@END_TWIST@": end_twist(effects),
        "@LINE_VALUES@": str(sum(e.line_values for e in effects)),
        "@LINE_PLACE@": f"4 * K + {2 + sum(e.bend_memory for e in effects)} * B",
    }
    laws = law_statements(effects)
    parts |= {"@LOAD@": source_contact.LOAD if grips else "", "@GRIP_SLOTS@": str(grips)}
    for placeholder, statements in (*parts.items(), *laws.items(), ("@PULL@", source_contact.PULL)):
        text = text.replace(placeholder, statements)
    return text


@lru_cache(maxsize=64)
def build(effects: tuple[type[Effect], ...], lanes: int, staged: bool) -> Callable[..., Any]:
    """The kernel `k(model, worlds)`; grid (blocks,) fused, (blocks, elements) staged. Compiled once, cached."""

    def advance(m: Model, w: Worlds, block: wp.int32, element: wp.int32): ...

    native: Any = wp.func_native(kernel_text(effects, lanes, staged))(advance)

    if staged:

        def substep_stage(m: Model, w: Worlds):
            block, element = wp.tid()  # type: ignore[misc]
            native(m, w, block, element)

        entry = substep_stage
    else:

        def substeps_fused(m: Model, w: Worlds):
            native(m, w, wp.tid(), 0)

        entry = substeps_fused
    # One module per source text, so that adding an effect never recompiles or changes another kernel.
    return wp.kernel(entry, enable_backward=False, module="unique")


@wp.kernel(enable_backward=False)
def _tick(clock: wp.array(dtype=wp.int32)):  # type: ignore[valid-type]
    clock[0] = clock[0] + 1


def launch_staged(
    run: Any, model: Any, record: Any, periods: int, device: str, sizes: tuple[int, ...]
) -> None:
    """Launches of springs, bends and pairs, particles and held a substep; `sizes` are their element counts.

    The schedule of CUDA, where one period is recorded as a graph and replayed; on CPU the same launches run
    one by one, which is how the schedule is tested.
    """

    def one_period() -> None:
        for sub in range(model.substeps):
            for stage, size in enumerate(sizes):
                if size:
                    model.stage, model.stage_sub = stage, sub
                    wp.launch(run, dim=(model.blocks, size), inputs=[model, record], device=device)
        model.stage = len(sizes)
        wp.launch(run, dim=(model.blocks, 3 * model.particles), inputs=[model, record], device=device)
        wp.launch(_tick, dim=1, inputs=[record.clock], device=device)

    if not wp.get_device(device).is_cuda:
        for _ in range(periods):
            one_period()
        return
    with wp.ScopedCapture(device=device) as capture:
        one_period()
    for _ in range(periods):
        wp.capture_launch(capture.graph)
