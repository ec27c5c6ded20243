"""Images, colour spaces and display transforms that users really have and that break converters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from tests.nasty_materials import Case, output_of, plain, tree_of
from tests.nasty_scenes import cube, link, material, png, save

SAVED = ("BMP", "IRIS", "PNG", "JPEG", "JPEG2000", "TARGA", "TARGA_RAW", "CINEON", "DPX", "OPEN_EXR", "HDR", "TIFF",
         "WEBP", "AVIF")  # fmt: skip


def shown(name: str, image: Any) -> Any:
    """A tetrahedron that shows ``image``."""
    return cube(name, material(name, image=image))


def formats(folder: Path) -> Path:
    """Every format that this Blender writes, 8 and 16 bits."""
    scene = plain()
    for kind in SAVED:
        for depth in ("8", "16"):
            image = bpy.data.images.new(f"{kind}{depth}", 40, 36, float_buffer=depth == "16")
            settings = scene.render.image_settings
            try:
                settings.file_format = kind
            except TypeError:
                break  # not in this build
            settings.color_mode = "RGBA" if "RGBA" in _choices(settings, "color_mode") else "RGB"
            if depth in _choices(settings, "color_depth"):
                settings.color_depth = depth
            path = folder / "formats" / f"{kind}{depth}.{kind.lower()}"
            path.parent.mkdir(exist_ok=True)
            image.save_render(str(path), scene=scene)
            bpy.data.images.remove(image)
            shown(path.stem, bpy.data.images.load(str(path)))
    return save(folder / "formats.blend")


def _choices(holder: Any, name: str) -> set[str]:
    """The values that an enum takes at the moment."""
    try:
        setattr(holder, name, "?")
    except TypeError as error:
        return set(str(error).partition("not found in (")[2].rstrip(")").replace("'", "").split(", "))
    return set()


def odd_pixels(folder: Path) -> Path:
    """Palettes, one bit, 16-bit grey, grey with alpha, CMYK, float TIFF, animated GIF and WebP, one row, one column."""
    from PIL import Image

    plain()
    place = folder / "odd"
    place.mkdir()
    picture = Image.fromarray(np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3) * 3)
    picture.convert("P").save(place / "palette.png", transparency=0)
    picture.convert("1").save(place / "bit.png")
    picture.convert("LA").save(place / "grey_alpha.png")
    Image.fromarray(np.arange(24, dtype=np.uint16).reshape(4, 6) * 2000).save(place / "grey16.png")
    picture.convert("CMYK").save(place / "cmyk.jpg")
    picture.convert("L").save(place / "grey.jpg")
    Image.fromarray(np.linspace(-2, 7, 24, dtype=np.float32).reshape(4, 6)).save(place / "float.tif")
    picture.convert("P").save(place / "moving.gif", save_all=True, append_images=[picture.convert("P")])
    picture.save(place / "moving.webp", save_all=True, append_images=[picture])
    picture.resize((1, 6)).save(place / "column.png")
    picture.resize((300, 1)).save(place / "row.tga")
    picture.save(place / "really_a_jpeg.png", format="JPEG")
    picture.save(place / "no_suffix", format="PNG")
    for path in sorted(place.iterdir()):
        shown(path.name, bpy.data.images.load(str(path)))
    return save(folder / "odd_pixels.blend")


def exrs(folder: Path) -> Path:
    """Multilayer, half with NaN and infinity, one channel, depth alone, names of one's own."""
    import OpenEXR

    plain()
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    broken = values.astype(np.float16)
    broken[0, :2] = np.nan, np.inf
    red_green_blue = {"R": values, "G": values, "B": values}
    layered = {f"ViewLayer.Combined.{name}": values for name in "RGBA"} | {"ViewLayer.Depth.Z": values}
    for name, channels in {
        "multilayer": layered,
        "half": {"R": broken, "G": broken, "B": broken, "A": broken},
        "grey": {"Y": values},
        "depth": {"Z": values},
        "luminance": {"Y": values, "A": values},
        "own": {"temperature": values},
        "rgb": red_green_blue,
        "two": {"R": values, "G": values},
    }.items():
        path = folder / "exr" / f"{name}.exr"
        path.parent.mkdir(exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {key: value.copy() for key, value in channels.items()}) as file:
            file.write(str(path))
        shown(name, bpy.data.images.load(str(path)))
    return save(folder / "exrs.blend")


def corrupt(folder: Path) -> Path:
    """Files that are no images: cut short, empty, text, noise, a folder."""
    plain()
    whole = png(folder / "whole.png")
    bytes_ = (folder / "whole.png").read_bytes()
    bpy.data.images.remove(whole)
    for name, content in (
        ("cut.png", bytes_[: len(bytes_) // 2]),
        ("empty.png", b""),
        ("text.jpg", b"<html>404</html>"),
        ("noise.exr", b"v/1\x01" + bytes(range(256))),
        ("noise.hdr", b"#?RADIANCE\n" + bytes(range(256))),
        ("noise.tif", b"II*\x00" + bytes(range(256))),
    ):
        (folder / name).write_bytes(bytes_)
        image = bpy.data.images.load(str(folder / name))
        (folder / name).write_bytes(content)
        shown(name, image)
    (folder / "folder.png").mkdir()
    image = bpy.data.images.new("folder.png", 1, 1)
    image.source, image.filepath_raw = "FILE", str(folder / "folder.png")
    shown("folder.png", image)
    return save(folder / "corrupt.blend")


def changed(folder: Path) -> Path:
    """Packed and then painted over, generated and never saved, generated in floats that are not finite, huge values."""
    plain()
    packed = png(folder / "packed.png")
    packed.pack()
    packed.pixels = [0.25] * len(packed.pixels)
    shown("packed", packed)
    on_disk = png(folder / "painted.png")
    on_disk.pixels = [0.75] * len(on_disk.pixels)
    shown("painted", on_disk)
    generated = bpy.data.images.new("generated", 3, 3, float_buffer=True)
    generated.pixels = [float("nan"), float("inf"), 1e30, 1] * 9
    generated.file_format = "OPEN_EXR"
    generated.pack()
    shown("generated", generated)
    grid = bpy.data.images.new("grid", 8, 8)
    grid.generated_type = "COLOR_GRID"
    shown("grid", grid)
    tiled = bpy.data.images.new("tiled", 4, 4, tiled=True)
    tiled.tiles.new(tile_number=1002)
    shown("tiled", tiled)
    return save(folder / "changed.blend")


def sequences(folder: Path) -> Path:
    """An image sequence with a missing frame, one that starts elsewhere, a movie that is none, a UDIM of one tile."""
    plain()
    for frame in (1, 3, 7):
        bpy.data.images.remove(png(folder / "frames" / f"frame_{frame:04d}.png"))
    for name, start in (("missing frame", 2), ("starts later", 7), ("beyond", 90)):
        image = bpy.data.images.load(str(folder / "frames" / "frame_0001.png"))
        image.source = "SEQUENCE"
        obj = shown(name, image)
        node = next(n for n in obj.active_material.node_tree.nodes if n.type == "TEX_IMAGE")
        node.image_user.frame_duration, node.image_user.frame_offset = 10, start - 1
        node.image_user.use_auto_refresh = True
    (folder / "movie.mp4").write_bytes(b"no movie")
    movie = png(folder / "standin.png")
    movie.source, movie.filepath_raw = "MOVIE", str(folder / "movie.mp4")
    shown("movie", movie)
    bpy.data.images.remove(png(folder / "udim.1005.png"))
    udim = png(folder / "udim.1001.png")
    udim.source = "TILED"
    udim.filepath_raw = str(folder / "udim.<UDIM>.png")
    udim.tiles[0].number = 1005
    shown("udim", udim)
    return save(folder / "sequences.blend")


def inner_images(folder: Path) -> Path:
    """Render Result and Viewer Node as textures, an image without size, one used in a brush alone."""
    scene = plain()
    scene.camera = link("camera", bpy.data.cameras.new("camera"))
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 1
    bpy.ops.render.render()
    shown("Render Result", bpy.data.images["Render Result"])
    group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
    group.nodes.new("CompositorNodeRLayers")
    scene.compositing_node_group = group
    shown("unnamed", png(folder / "x.png")).active_material.node_tree.nodes["Image Texture"].image.name = "\t\n"
    return save(folder / "inner_images.blend")


def alpha_modes(folder: Path) -> Path:
    """Every alpha mode, colour space and projection of an Image Texture node."""
    plain()
    for mode in ("STRAIGHT", "PREMUL", "CHANNEL_PACKED", "NONE"):
        image = png(folder / f"{mode}.png")
        image.alpha_mode = mode
        shown(mode, image)
    for space in sorted(_choices(bpy.data.images[0].colorspace_settings, "name")):
        image = png(folder / f"{space.replace('/', '_')}.png")
        image.colorspace_settings.name = space
        shown(space, image)
    for projection in ("FLAT", "BOX", "SPHERE", "TUBE"):
        obj = shown(projection, png(folder / f"{projection}.png"))
        obj.active_material.node_tree.nodes["Image Texture"].projection = projection
    return save(folder / "alpha_modes.blend")


def patched(folder: Path, name: str, old: bytes, new: bytes) -> Path:
    """The open file, with bytes of it replaced by others of the same length."""
    path = save(folder / name, compress=False)
    raw = path.read_bytes()
    assert len(old) == len(new) and old in raw
    path.write_bytes(raw.replace(old, new))
    return path


def unknown_colour_space(folder: Path) -> Path:
    """A colour space of somebody's own OpenColorIO configuration."""
    plain()
    image = png(folder / "plate.png")
    image.colorspace_settings.name = "ACEScg"
    shown("plate", image)
    generated = bpy.data.images.new("generated", 4, 4, float_buffer=True)
    generated.colorspace_settings.name = "ACEScg"
    shown("generated", generated)
    return patched(folder, "unknown_colour_space.blend", b"ACEScg\x00", b"MYSPAC\x00")


def unknown_view(folder: Path) -> Path:
    """View transform, look and display of another configuration."""
    scene = plain()
    cube()
    scene.view_settings.view_transform = "AgX"
    scene.view_settings.look = "AgX - Punchy"
    path = patched(folder, "unknown_view.blend", b"AgX - Punchy\x00", b"Odd - Punchy\x00")
    path.write_bytes(
        path.read_bytes().replace(b"\x00AgX\x00", b"\x00ODT\x00").replace(b"\x00sRGB\x00", b"\x00sXYZ\x00")
    )
    return path


def odd_view(folder: Path) -> Path:
    """Exposure and gamma at their limits, curves, white balance; a film format as output."""
    scene = plain()
    cube()
    view = scene.view_settings
    view.view_transform, view.exposure, view.gamma = "Filmic", 32, 5
    view.use_curve_mapping = view.use_white_balance = True
    view.white_balance_temperature = 1800
    settings = scene.render.image_settings
    for media, kind in (("VIDEO", "FFMPEG"), ("MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER")):
        try:
            settings.media_type = media
            settings.file_format = kind
        except TypeError:
            continue  # not in this build
    return save(folder / "odd_view.blend")


def everywhere(folder: Path) -> Path:
    """One image as colour, number, normal, bump, alpha and light; a colour as normal map; a map as colour."""
    plain()
    image = png(folder / "all.png")
    made, tree, principled = tree_of("everywhere")
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    for socket in principled.inputs:
        if socket.type != "SHADER" and socket.name not in {"Normal", "Coat Normal", "Tangent"}:
            tree.links.new(node.outputs["Color"], socket)
    tree.links.new(node.outputs["Color"], principled.inputs["Normal"])
    tree.links.new(node.outputs["Alpha"], output_of(tree).inputs["Displacement"])
    cube("everywhere", made)
    return save(folder / "everywhere.blend")


CONVERTS: dict[str, Case] = {
    "formats": (formats, ()),
    "odd pixels": (odd_pixels, ()),
    "exrs": (exrs, ("image 'half.exr'", "not finite")),
    "corrupt": (corrupt, ("cut.png", "empty.png", "text.jpg", "noise.exr", "noise.hdr", "noise.tif", "folder.png")),
    "changed": (changed, ("image 'generated'", "not finite", "UDIM image 'tiled'")),
    "sequences": (sequences, ("movie.mp4", "animated image", "UDIM image 'udim.1001.png'")),
    "inner images": (inner_images, ("image 'Render Result'", "compositor")),
    "alpha modes": (alpha_modes, ("box image projection",)),
    "unknown colour space": (unknown_colour_space, ('image colorspace "MYSPAC" not found',)),
    "unknown view": (unknown_view, ('scene view "ODT" not found, setting to "Standard"',)),
    "odd view": (odd_view, ()),
    "everywhere": (everywhere, ()),
}
"""Name -> builder, and what warnings and findings must say."""
