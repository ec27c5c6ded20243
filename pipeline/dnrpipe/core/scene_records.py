"""What the conversion of a scene says of it, as typed records.

scene/summary.json    `SceneSummary`
scene/census.json     `Census`, with a `Finding` for each feature
scene/prepared.json   `Conversion`, written last
passes/raster.json    `RasterChoice`
"""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict

from dnrtrain.records import Record

Vector = tuple[float, float, float]
Lens = dict[str, float]
"""``aperture_radius`` and ``focus_distance`` of a thin lens, scene units."""
FindingKind = Literal["exact", "approximated", "baked", "ignored", "missing"]


class SceneRecord(Record):
    """Paths may hold surrogates (bytes that are no UTF-8), which pydantic's own JSON refuses: read and write plain
    values."""

    model_config = ConfigDict(frozen=True)


class Bounds(SceneRecord):
    """Axis-aligned box, and a sphere about its centre that holds every vertex; scene units."""

    min: Vector
    max: Vector
    center: Vector
    radius: float


class SceneCamera(SceneRecord):
    """A camera of the scene file, at one frame.

    Args:
        frame: of the animation; None for the frame that is converted.
        active: whether the scene renders with it; not said of an animation's frames.
        c2w: camera-to-world, 4x4 rows.
        type: "PERSP", "ORTHO" or "PANO".
        lens, sensor_width, sensor_height: millimetres.
        sensor_fit: "AUTO", "HORIZONTAL" or "VERTICAL".
        shift_x, shift_y: of the longer side of the image, or of the side that ``sensor_fit`` names.
        clip_start, clip_end, ortho_scale: scene units.
        pixel_aspect: height of a pixel over its width.
    """

    frame: int | None = None
    name: str
    active: bool = False
    c2w: tuple[tuple[float, ...], ...]
    type: str
    lens: float
    sensor_width: float
    sensor_height: float
    sensor_fit: str
    shift_x: float
    shift_y: float
    clip_start: float
    clip_end: float
    ortho_scale: float
    dof: Lens | None
    pixel_aspect: float = 1.0


class Standpoint(SceneRecord):
    """A place for a camera in free air, and a point to look at; world space."""

    place: Vector
    target: Vector


class Surroundings(SceneRecord):
    """What the scene's own camera stands in.

    Args:
        enclosed: share of all directions in which it meets a surface; of an animated camera the mean over its path.
        standpoints: in free air around its place or beside its path, in random order.
    """

    enclosed: float
    moves: bool
    standpoints: list[Standpoint]


MOST_LOST = 0.8
"""Share of triangles without a texel beyond which `AtlasFacts.loses_most`: `bricks` has 0.86, the other example scenes
0.11 to 0.71."""


class AtlasFacts(SceneRecord):
    """The scene atlas, measured at ``size``² texels.

    Args:
        method: "smart" (Blender's Smart UV Project) or "charts" (planar ones).
        occupancy: covered texels, of all.
        overlap: texels whose centre lies in more than one triangle, of the covered ones.
        triangles_without_texel: triangles that hold no texel's centre, of all.
        texels_per_unit: ``median``, ``min`` and ``max`` over the objects, texels per scene unit.
    """

    method: str
    seconds: float
    size: int
    occupancy: float
    overlap: float
    triangles_without_texel: float
    texels_per_unit: dict[str, float]

    @property
    def loses_most(self) -> bool:
        """Whether light of the usual number of texels is much too blurred: most triangles hold none."""
        return self.triangles_without_texel > MOST_LOST


class SceneSummary(SceneRecord):
    """What later stages and the report need to know of a converted scene.

    Args:
        triangles: of all meshes, each instance's shape counted once.
        objects: the highest object number; ``object_names``: by number.
        animation: the active camera over the frame range; empty where it does not move.
        surroundings: of the active camera; None where it is no perspective camera, or meets nothing.
        resolution: width and height that the file asks for, pixels.
        repairs: dropped triangles and replaced normals, UVs and colours, by kind.
        has_light: whether the file brought light of its own.
        bake_size: texels of a baked texture's side; None where nothing is baked.
        external: SHA-256 of each file that the scene refers to, or "missing", by path.
    """

    bounds: Bounds
    triangles: int
    objects: int
    instances: int
    object_names: dict[str, str]
    cameras: list[SceneCamera]
    animation: list[SceneCamera]
    surroundings: Surroundings | None = None
    resolution: tuple[int, int]
    blender_version: str
    atlas: AtlasFacts
    repairs: dict[str, int]
    has_light: bool
    bake_size: int | None
    external: dict[str, str]
    warnings: list[str]


class Finding(SceneRecord):
    """One feature and what became of it.

    kind: exact (converted one to one), approximated (converted, visibly different in general), baked
    (turned into an image), ignored (left out), missing (the scene refers to something that is not there).
    """

    kind: FindingKind
    object: str | None
    material: str | None
    feature: str
    note: str


class MaterialFacts(SceneRecord):
    """What a material's nodes imply for light transport. Only nodes that reach the active output count.

    Args:
        bsdfs: labels of its shader nodes; ``nodes``: how many of each label; ``procedural``: of its textures without
            image; ``view_dependent``: of its nodes whose value depends on the view.
        ior: largest index of refraction of a transmitting lobe.
        min_roughness: smallest roughness of its mirror-like lobes, 0 to 1; None where it has none, or an image gives
            it (then ``roughness_linked``).
        objects: some that show it.
    """

    bsdfs: list[str]
    nodes: dict[str, int]
    procedural: list[str]
    reflects: bool
    glossy: bool
    transparent: bool
    transmissive: bool
    refractive: bool
    ior: float | None
    emissive: bool
    subsurface: bool
    metallic: bool
    normal_map: bool
    bump: bool
    volume: bool
    displacement: bool
    thin_film: bool
    hair: bool
    view_dependent: list[str]
    min_roughness: float | None
    roughness_linked: bool
    objects: list[str]


class LightFacts(SceneRecord):
    """A lamp.

    Args:
        type: "POINT", "SPOT", "SUN" or "AREA".
        power: watts (a sun: W/m²), exposure included.
        color: linear Rec.709.
        size: of an area lamp width and height, of a sun its angle in radians, of others the radius; scene units.
    """

    name: str
    type: str
    power: float
    color: Vector
    shape: str | None = None
    size: float | tuple[float, float]


class WorldFacts(SceneRecord):
    """The world. kind: "hdri", "sky", "nodes" or "color". emits: whether it gives light. nodes: how many of a type."""

    name: str
    kind: str
    image: str | None
    emits: bool
    volume: bool
    nodes: dict[str, int]


class ImageFacts(SceneRecord):
    """An image in use. size: width and height, pixels. float: not 8 bits a channel. missing: its file is gone."""

    name: str
    size: tuple[int, int]
    float: bool
    packed: bool
    color_space: str
    missing: bool


class Census(SceneRecord):
    """What renders of a scene see: counts, and the features that decide which light-transport effects matter.

    Args:
        blender, file_version: of the program that converted it; of the one that saved the file.
        objects: how many of each Blender type.
        triangles: that rays can hit, instances included; ``triangles_by_object``: of one instance.
        procedural_textures, transparency, …, view_dependent_nodes: names of the materials that have them.
        volumes: names of volume objects and of materials with a volume.
        hair, depth_of_field, motion: names of objects with hair, of cameras with depth of field, of objects that
            motion blur would show moving.
        findings: what became of each feature, in order of discovery.
    """

    scene: str
    blender: str
    file_version: str
    objects: dict[str, int]
    meshes: int
    instances: int
    triangles: int
    triangles_by_object: dict[str, int]
    materials: dict[str, MaterialFacts]
    default_material: list[str]
    lights: list[LightFacts]
    world: WorldFacts | None
    images: list[ImageFacts]
    node_groups: list[str]
    procedural_textures: list[str]
    transparency: list[str]
    transmission: list[str]
    emission: list[str]
    subsurface: list[str]
    metals: list[str]
    normal_maps: list[str]
    view_dependent_nodes: list[str]
    volumes: list[str]
    hair: list[str]
    depth_of_field: list[str]
    motion: list[str]
    view_transform: str
    render_engine: str
    findings: list[Finding]


class Conversion(SceneRecord):
    """A conversion that is whole. fingerprint: of its inputs. files: SHA-256 of each file of ``scene/``, by path."""

    fingerprint: str
    files: dict[str, str]


class RasterChoice(SceneRecord):
    """The engine that draws a workspace's rasterised colour. requested: the setting. reason: why it is this one."""

    requested: str
    engine: str
    reason: str
