"""Materials by seed, drawn for a role: what a thing, a floor, a wall, a cloth or a metal part is made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from bpy.types import Image, Material
from building import cut_out_leaf, make_image, material, node, normal_picture, picture, principled, wire
from patterns import normals_from_height, plain

from factory import textures
from factory.dice import Dice, Rgb, linear

METALS: list[Rgb] = [
    (0.92, 0.92, 0.92),
    (0.56, 0.57, 0.58),
    (1.0, 0.77, 0.34),
    (0.83, 0.58, 0.24),
    (0.95, 0.64, 0.54),
    (0.3, 0.29, 0.28),
]


SHEETS = 7  # pairs of colour and normal pictures in a scene


class Finishes:
    """Makes materials and hands some of them out again, as artists do. Pictures are few, so that files stay small."""

    def __init__(self, dice: Dice) -> None:
        self.dice = dice
        self.made: dict[str, list[Material]] = {}
        self.drawn: list[tuple[Image, Image]] = []
        self.kinds: dict[str, dict[Callable[[], Material], float]] = {
            "thing": {
                self.plastic: 3.0,
                self.matte: 2.5,
                self.printed: 7.0,
                self.metal: 2.2,
                self.worn: 1.0,
                self.brushed: 1.0,
                self.coated: 1.5,
                self.cloth: 0.8,
                self.glass: 1.2,
                self.tinted_glass: 0.9,
                self.frosted_glass: 0.5,
                self.waxy: 0.9,
                self.translucent: 0.3,
                self.glow: 0.25,
                self.grainy: 0.4,
            },
            "ground": {self.printed: 6.0, self.matte: 2.0, self.plastic: 1.0, self.brushed: 0.3, self.grainy: 0.5},
            "terrain": {self.natural: 3.0, self.printed: 1.0, self.matte: 0.3},
            "wall": {self.printed: 3.0, self.paint: 4.0, self.grainy: 0.3},
            "ceiling": {self.paint: 5.0, self.printed: 1.0},
            "wood": {self.timber: 3.0, self.paint: 1.0, self.plastic: 0.5},
            "cloth": {self.cloth: 2.0, self.printed: 3.0, self.velvet: 1.0, self.matte: 0.5},
            "metal": {self.metal: 3.0, self.brushed: 1.0, self.worn: 0.5},
            "glass": {self.glass: 3.0, self.tinted_glass: 2.0, self.frosted_glass: 0.7},
            "ceramic": {self.plastic: 2.0, self.printed: 2.0, self.coated: 1.0, self.matte: 1.0},
            "shade": {self.translucent: 1.0},
            "paper": {self.paper: 1.0},
            "bulb": {self.glow: 1.0},
            "soil": {self.earth: 1.0},
            "leaf": {self.leaf: 1.0},
            "net": {self.net: 1.0},
            "mirror": {self.mirror: 1.0},
            "plain": {self.plastic: 1.0, self.matte: 1.0},
            "clear": {self.glass: 1.0},
            "liquid": {self.liquid: 1.0},
        }

    def draw(self, role: str, again: float = 0.25) -> Material:
        """A material for ``role``; one that was drawn for it before with probability ``again``."""
        known = self.made.setdefault(role, [])
        if known and self.dice.chance(again):
            return self.dice.pick(known)
        known.append(self.dice.weighted(self.kinds[role])())
        return known[-1]

    # ---------------------------------------------------------------- opaque

    def _number(self, word: str) -> str:
        return f"{word} {sum(map(len, self.made.values())) + 1}"

    def plastic(self) -> Material:
        return material(self._number("Plastic"), self.dice.colour(), Roughness=self.dice.log(0.03, 0.5))

    def matte(self) -> Material:
        return material(self._number("Matte"), self.dice.colour(), Roughness=self.dice.uniform(0.6, 1.0))

    def paint(self) -> Material:
        """Wall paint: light more often than dark."""
        colour = self.dice.colour((0.0, 0.5), (0.35, 0.95))
        return material(self._number("Paint"), colour, Roughness=self.dice.uniform(0.4, 0.95))

    def paper(self) -> Material:
        return material(self._number("Paper"), self.dice.colour((0.0, 0.15), (0.75, 0.95)), Roughness=0.9)

    def earth(self) -> Material:
        return material(self._number("Soil"), (0.05, 0.035, 0.025), Roughness=0.95, Specular_IOR_Level=0.2)

    def coated(self) -> Material:
        """Car paint or varnish."""
        return material(
            self._number("Coated"),
            self.dice.colour((0.2, 0.95)),
            Metallic=self.dice.pick([0.0, 0.0, 0.6]),
            Roughness=self.dice.uniform(0.3, 0.7),
            Coat_Weight=1.0,
            Coat_Roughness=self.dice.uniform(0.0, 0.15),
        )

    def velvet(self) -> Material:
        sheen = self.dice.uniform(0.3, 1.0)
        return material(self._number("Velvet"), self.dice.colour((0.2, 0.9)), Roughness=0.9, Sheen_Weight=sheen)

    def waxy(self) -> Material:
        """Subsurface scattering: wax, soap, fruit, skin."""
        made = material(
            self._number("Waxy"),
            self.dice.colour((0.1, 0.7), (0.4, 0.95)),
            Roughness=self.dice.uniform(0.2, 0.6),
            Subsurface_Weight=self.dice.uniform(0.3, 1.0),
            Subsurface_Scale=self.dice.log(0.01, 0.08),
        )
        principled(made).inputs["Subsurface Radius"].default_value = (1.0, 0.5, 0.3)
        return made

    def grainy(self) -> Material:
        """Procedural stone: noise through the colour and as bump."""
        made = material(self._number("Grainy"), (0.5, 0.5, 0.5), Roughness=self.dice.uniform(0.4, 0.9))
        noise = node(made, "TexNoise", inputs={"Scale": self.dice.log(4, 20), "Detail": 4.0})
        wire(made, node(made, "TexCoord").outputs["Object"], noise.inputs["Vector"])
        mixed = node(made, "Mix", data_type="RGBA")
        mixed.inputs[6].default_value = (*self.dice.colour(), 1.0)
        mixed.inputs[7].default_value = (*self.dice.colour(), 1.0)
        wire(made, noise.outputs["Fac"], mixed.inputs[0])
        wire(made, mixed.outputs[2], principled(made).inputs["Base Color"])
        bend = node(made, "Bump", inputs={"Strength": self.dice.uniform(0.1, 0.6), "Distance": 0.02})
        wire(made, noise.outputs["Fac"], bend.inputs["Height"])
        wire(made, bend.outputs["Normal"], principled(made).inputs["Normal"])
        return made

    # ---------------------------------------------------------------- pictures

    def _sheet(self, pattern: Callable[[Dice], textures.Picture] | None = None) -> tuple[Image, Image]:
        """(colour, normal) pictures: new ones while the file may grow, else some that are there."""
        if self.drawn and (len(self.drawn) >= SHEETS or (pattern is None and self.dice.chance(0.2))):
            return self.dice.pick(self.drawn)
        draw = pattern or self.dice.weighted(textures.PATTERNS)
        colour, height = draw(self.dice)
        name = f"{draw.__name__} {len(self.drawn) + 1}"
        normals = normals_from_height(height, self.dice.uniform(0.5, 4.0))
        pair = make_image(name, colour, jpeg=88), make_image(f"{name} normal", normals, data=True, jpeg=90)
        self.drawn.append(pair)
        return pair

    def _dress(self, made: Material, pattern: Callable[[Dice], textures.Picture] | None, repeat: float) -> Material:
        """Put a picture on the colour, and often its relief on the normal."""
        colour, normal = self._sheet(pattern)
        count = (repeat, repeat) if abs(repeat - 1) > 0.01 else None
        picture(made, colour, "Base Color", repeat=count)
        kind = self.dice.weighted({"none": 4.0, "normal": 4.5, "bump": 1.5})
        if kind == "normal":
            normal_picture(made, normal, strength=self.dice.uniform(0.3, 1.0), repeat=count)
        elif kind == "bump":
            shown = picture(made, colour, repeat=count)
            bend = node(made, "Bump", inputs={"Strength": self.dice.uniform(0.2, 0.7), "Distance": 0.01})
            wire(made, shown.outputs["Color"], bend.inputs["Height"])
            wire(made, bend.outputs["Normal"], principled(made).inputs["Normal"])
        return made

    def printed(self) -> Material:
        made = material(self._number("Printed"), (0.5, 0.5, 0.5), Roughness=self.dice.log(0.05, 0.95))
        self._dress(made, None, self.dice.pick([1.0, 1.0, 2.0, 3.0]))
        if self.dice.chance(0.3):
            image = make_image(f"roughness {made.name}", textures.smudges(self.dice)[::2, ::2], data=True, jpeg=88)
            picture(made, image, "Roughness")
        if self.dice.chance(0.15):
            principled(made).inputs["Coat Weight"].default_value = 1.0
        return made

    def natural(self) -> Material:
        """Sand, soil, gravel or paving."""
        made = material(self._number("Terrain"), (0.3, 0.28, 0.25), Roughness=self.dice.uniform(0.7, 1.0))
        return self._dress(made, self.dice.pick([textures.grit, textures.grit, textures.chips, textures.tiles]), 1.0)

    def timber(self) -> Material:
        made = material(self._number("Timber"), (0.3, 0.2, 0.1), Roughness=self.dice.uniform(0.2, 0.7))
        return self._dress(made, textures.boards, self.dice.pick([1.0, 2.0]))

    def cloth(self) -> Material:
        sheen = self.dice.pick([0.0, 0.3, 0.7])
        made = material(self._number("Cloth"), (0.4, 0.3, 0.3), Roughness=0.9, Sheen_Weight=sheen)
        return self._dress(made, textures.cloth, self.dice.pick([2.0, 4.0]))

    # ---------------------------------------------------------------- metal

    def metal(self) -> Material:
        """From a perfect mirror to rough casting."""
        roughness = self.dice.weighted({0.0: 1.0, self.dice.uniform(0.03, 0.2): 2.0, self.dice.uniform(0.2, 0.6): 2.0})
        colour = self.dice.pick(METALS) if self.dice.chance(0.8) else self.dice.colour((0.3, 0.8), (0.5, 0.95))
        made = material(self._number("Metal"), colour, Metallic=1.0, Roughness=roughness)
        if self.dice.chance(0.15):
            normal_picture(made, self._sheet()[1], strength=self.dice.uniform(0.1, 0.5), repeat=(2.0, 2.0))
        return made

    def mirror(self) -> Material:
        return material(self._number("Mirror"), (0.9, 0.9, 0.9), Metallic=1.0, Roughness=0.0)

    def brushed(self) -> Material:
        made = material(self._number("Brushed"), self.dice.pick(METALS), Metallic=1.0)
        image = make_image(made.name.lower(), textures.smudges(self.dice)[::2, ::2], data=True, jpeg=88)
        picture(made, image, "Roughness", repeat=(2.0, 2.0))
        return made

    def worn(self) -> Material:
        """Paint that has gone from the metal in places."""
        made = material(self._number("Worn"), (0.4, 0.4, 0.4))
        bare = textures.wear(self.dice)[::2, ::2]
        size = bare.shape[0]
        coat, metal = plain(size, size, self.dice.shown((0.2, 0.9))), self.dice.shown((0.0, 0.2), (0.5, 0.8))
        colour = coat + (np.array(metal) - coat) * bare[..., None]
        picture(made, make_image(f"{made.name} colour", colour, jpeg=90), "Base Color")
        picture(made, make_image(f"{made.name} metallic", bare, data=True, jpeg=90), "Metallic")
        roughness = 0.25 + self.dice.uniform(-0.2, 0.5) * (bare - 0.3)
        picture(made, make_image(f"{made.name} roughness", roughness, data=True, jpeg=90), "Roughness")
        return made

    # ---------------------------------------------------------------- light passes or starts

    def glass(self) -> Material:
        """Clear glass or gem, by the Principled or the Glass node."""
        ior = self.dice.pick([1.33, 1.45, 1.5, 1.52, 1.77, 2.42])
        if self.dice.chance(0.7):
            return material(self._number("Glass"), (1, 1, 1), Roughness=0.0, IOR=ior, Transmission_Weight=1.0)
        made = material(self._number("Glass node"), (1, 1, 1))
        shader = node(made, "BsdfGlass", inputs={"Roughness": 0.0, "IOR": ior})
        wire(made, shader.outputs["BSDF"], made.node_tree.nodes["Material Output"].inputs["Surface"])
        return made

    def tinted_glass(self) -> Material:
        """Coloured at the surface, or by what the inside absorbs."""
        if self.dice.chance(0.6):
            colour = self.dice.colour((0.2, 0.8), (0.6, 0.98))
            return material(self._number("Tinted glass"), colour, Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)
        return self.liquid()

    def liquid(self) -> Material:
        made = material(self._number("Absorbing"), (1, 1, 1), Roughness=0.0, IOR=1.4, Transmission_Weight=1.0)
        colour = (*self.dice.colour((0.4, 0.95), (0.5, 0.95)), 1.0)
        absorb = node(made, "VolumeAbsorption", inputs={"Color": colour, "Density": self.dice.log(2, 15)})
        wire(made, absorb.outputs["Volume"], made.node_tree.nodes["Material Output"].inputs["Volume"])
        return made

    def frosted_glass(self) -> Material:
        colour = self.dice.colour((0.0, 0.5), (0.7, 1.0))
        roughness = self.dice.uniform(0.08, 0.45)
        return material(self._number("Frosted"), colour, Roughness=roughness, IOR=1.47, Transmission_Weight=1.0)

    def translucent(self) -> Material:
        """Lamp shade, sail, thin cloth: a share of the light passes, diffusely."""
        colour = self.dice.colour((0.0, 0.5), (0.6, 0.95))
        made = material(self._number("Shade"), colour, Roughness=0.9, Specular_IOR_Level=0.0)
        through = node(made, "BsdfTranslucent", inputs={"Color": (*colour, 1.0)})
        both = node(made, "MixShader", inputs={"Fac": self.dice.uniform(0.3, 0.7)})
        wire(made, principled(made).outputs["BSDF"], both.inputs[1])
        wire(made, through.outputs["BSDF"], both.inputs[2])
        wire(made, both.outputs["Shader"], made.node_tree.nodes["Material Output"].inputs["Surface"])
        return made

    def glow(self) -> Material:
        """Emissive surface, white to coloured."""
        made = material(self._number("Glow"), (0.8, 0.8, 0.8), Emission_Strength=self.dice.log(3, 40))
        colour = self.dice.colour((0.0, 0.7), (0.85, 1.0))
        principled(made).inputs["Emission Color"].default_value = (*colour, 1.0)
        return made

    # ---------------------------------------------------------------- cut-outs

    def _cut(self, name: str, sheet: np.ndarray) -> Material:
        """Alpha of a picture: by the Principled's input, or by a Mix with a Transparent BSDF."""
        made = material(name, linear((0.3, 0.4, 0.2)), Roughness=self.dice.uniform(0.35, 0.9))
        image = make_image(name.lower(), sheet)
        if self.dice.chance(0.5):
            shown = picture(made, image, "Base Color")
            wire(made, shown.outputs["Alpha"], principled(made).inputs["Alpha"])
            return made
        shown = picture(made, image, "Base Color")
        through = node(made, "BsdfTranslucent")
        wire(made, shown.outputs["Color"], through.inputs["Color"])
        cut_out_leaf(made, shown, through, self.dice.uniform(0.2, 0.5))
        return made

    def leaf(self) -> Material:
        return self._cut(self._number("Leaf"), textures.leaf(self.dice))

    def net(self) -> Material:
        return self._cut(self._number("Net"), textures.net(self.dice))
