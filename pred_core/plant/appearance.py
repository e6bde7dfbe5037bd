"""How the world looks to cameras: light, a wooden table, a rope of a colour of its own. Changes no physics."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pred_core.plant.rope import GROUND, RopeModel

ORANGE = (0.85, 0.36, 0.08)
TABLE = "table_texture"


def dress_spec(spec: mujoco.MjSpec, seed: int = 0) -> None:
    """Add two lights and a textured table to a model before it is compiled."""
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    for name, place in (("lamp_left", (-1.0, 0.8, 2.5)), ("lamp_right", (1.0, -0.8, 2.5))):
        aim = [-place[0], -place[1], -place[2]]
        light = spec.worldbody.add_light(name=name, pos=list(place), dir=aim, diffuse=[0.4, 0.4, 0.4])
        light.castshadow = False
    cover(spec, TABLE, table_picture(np.random.default_rng(seed)), repeat=1.0)
    spec.geom(GROUND).material = TABLE


def cover(spec: mujoco.MjSpec, name: str, picture: NDArray[np.uint8], repeat: float, uniform: bool = True) -> None:
    """Add a material `name` that shows a picture (H, W, 3), `repeat` times a metre.

    uniform False: over the texture coordinates of the object, with which it moves and bends.
    """
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D)
    texture.height, texture.width, texture.nchannel = picture.shape
    texture.data = picture.tobytes()
    material = spec.add_material(name=name, texrepeat=[repeat, repeat], texuniform=uniform, specular=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def dress_rope(rope: RopeModel, color: tuple[float, float, float] = ORANGE) -> None:
    """Colour the rope's capsules."""
    for link in rope.links:
        for geom in link.geoms:
            geom.rgba = [*color, 1.0]


def table_picture(generator: np.random.Generator, size: int = 512) -> NDArray[np.uint8]:
    """A grey-brown table top with grain, (size, size, 3)."""
    white = generator.standard_normal((size, size)).astype(np.float32)
    grain = np.sum([np.roll(white, k, axis=1) for k in range(24)], axis=0) / np.sqrt(24.0)
    speckle = generator.standard_normal((size, size)).astype(np.float32)
    tone = 0.48 + 0.03 * grain + 0.02 * speckle
    picture = tone[..., None] * np.array([1.0, 0.96, 0.9], np.float32)
    return np.clip(255.0 * picture, 0, 255).astype(np.uint8)


def speckled_picture(
    generator: np.random.Generator, color: tuple[float, float, float], size: int = 256, grain: int = 4
) -> NDArray[np.uint8]:
    """A patterned cloth of a main colour, (size, size, 3): blots of `grain` pixels, as printed cloth has."""
    cells = size // grain + 1
    tone = np.kron(generator.uniform(0.55, 1.25, (cells, cells)), np.ones((grain, grain)))[:size, :size]
    picture = tone[..., None] * np.array(color)
    return np.clip(255.0 * picture, 0, 255).astype(np.uint8)
