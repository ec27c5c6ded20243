"""Materials of ``build_interior.py``."""

from __future__ import annotations

from bpy.types import Material
from building import Rgb, make_image, material, node, normal_picture, picture, principled, wire
from interior_images import carpet, herringbone, painting, wallpaper
from patterns import normals_from_height, planks, weave, wood


def shade_cloth() -> Material:
    """Lampshade: half of the light passes, diffusely."""
    made = material("Lampshade", (0.85, 0.74, 0.55), Roughness=0.9, Specular_IOR_Level=0.0)
    through = node(made, "BsdfTranslucent", inputs={"Color": (0.85, 0.66, 0.42, 1.0)})
    both = node(made, "MixShader", inputs={"Fac": 0.5})
    wire(made, principled(made).outputs["BSDF"], both.inputs[1])
    wire(made, through.outputs["BSDF"], both.inputs[2])
    wire(made, both.outputs["Shader"], made.node_tree.nodes["Material Output"].inputs["Surface"])
    return made


def brickwork() -> Material:
    """Outer walls: the Brick texture node in UV space, with its own mortar as bump."""
    made = material("Brickwork", (0.4, 0.15, 0.1), Roughness=0.9)
    coordinates = node(made, "TexCoord")
    bricks = node(
        made,
        "TexBrick",
        inputs={
            "Color1": (0.36, 0.11, 0.07, 1.0),
            "Color2": (0.22, 0.07, 0.05, 1.0),
            "Mortar": (0.30, 0.28, 0.25, 1.0),
            "Scale": 3.5,
            "Mortar Size": 0.02,
            "Brick Width": 0.5,
            "Row Height": 0.25,
        },
    )
    wire(made, coordinates.outputs["UV"], bricks.inputs["Vector"])
    wire(made, bricks.outputs["Color"], principled(made).inputs["Base Color"])
    bend = node(made, "Bump", invert=True, inputs={"Strength": 0.7, "Distance": 0.01})
    wire(made, bricks.outputs["Fac"], bend.inputs["Height"])
    wire(made, bend.outputs["Normal"], principled(made).inputs["Normal"])
    return made


def glowing(name: str, colour: Rgb, strength: float) -> Material:
    """Emissive Principled."""
    made = material(name, (0.9, 0.9, 0.9), Emission_Strength=strength)
    principled(made).inputs["Emission Color"].default_value = (*colour, 1.0)
    return made


class Finishes:
    """The room's materials."""

    def __init__(self) -> None:
        colour, height = wallpaper()
        self.paper = material("Wallpaper and panelling", (0.5, 0.55, 0.5), Roughness=0.7)
        picture(self.paper, make_image("wallpaper", colour, jpeg=90), "Base Color")
        normal_picture(self.paper, make_image("panelling", normals_from_height(height, 2.5), data=True, jpeg=92))
        self.floor = material("Floorboards", (0.3, 0.18, 0.1), Roughness=0.33)
        boards = planks(512, 23, (0.24, 0.13, 0.07), (0.50, 0.32, 0.18), 8)
        picture(self.floor, make_image("floorboards", boards, jpeg=88), "Base Color")
        self.walnut = material("Walnut", (0.2, 0.1, 0.05), Roughness=0.35)
        grain = wood(512, 512, 29, (0.19, 0.10, 0.06), (0.44, 0.28, 0.17), 5)
        picture(self.walnut, make_image("walnut", grain, jpeg=88), "Base Color")
        height, _ = weave(128, 16, 3)
        threads = make_image("threads", normals_from_height(height, 2.0), data=True, jpeg=92)
        self.tweed = material("Tweed", (0.4, 0.25, 0.16), Roughness=0.95, Specular_IOR_Level=0.1, Sheen_Weight=0.2)
        picture(self.tweed, make_image("tweed", herringbone(), jpeg=90), "Base Color", repeat=(5.0, 5.0))
        normal_picture(self.tweed, threads, strength=0.6, repeat=(14.0, 14.0))
        self.velvet = material("Mustard velvet", (0.55, 0.30, 0.03), Roughness=0.9, Sheen_Weight=0.6)
        self.rug = material("Oriental rug", (0.4, 0.1, 0.1), Roughness=1.0, Specular_IOR_Level=0.0)
        picture(self.rug, make_image("oriental rug", carpet(), jpeg=90), "Base Color")
        normal_picture(self.rug, threads, strength=0.8, repeat=(24.0, 18.0))
        self.canvas = material("Painting", (0.5, 0.4, 0.4), Roughness=0.5)
        picture(self.canvas, make_image("painting", painting(), jpeg=92), "Base Color")
        self.gilt = material("Gilt", (0.80, 0.56, 0.24), Metallic=1.0, Roughness=0.32)
        self.mirror = material("Mirror", (0.90, 0.90, 0.90), Metallic=1.0, Roughness=0.0)
        self.enamel = material("White enamel", (0.80, 0.80, 0.76), Roughness=0.25)
        self.green = material("Green enamel", (0.02, 0.11, 0.06), Roughness=0.2)
        self.plaster = material("Hall plaster", (0.78, 0.70, 0.56), Roughness=0.9)
        self.glaze = material("Celadon glaze", (0.32, 0.50, 0.42), Roughness=0.1)
        self.pages = material("Paper", (0.80, 0.76, 0.66), Roughness=0.9)
        self.glass = material("Glass", (1.0, 1.0, 1.0), Roughness=0.0, IOR=1.5, Transmission_Weight=1.0)
        self.shade = shade_cloth()
        self.brick = brickwork()
        tints: list[Rgb] = [
            (0.30, 0.03, 0.03),
            (0.03, 0.08, 0.20),
            (0.05, 0.16, 0.09),
            (0.45, 0.27, 0.06),
            (0.10, 0.06, 0.04),
        ]
        self.books = [material(f"Book cloth {k + 1}", tint, Roughness=0.75) for k, tint in enumerate(tints)]
