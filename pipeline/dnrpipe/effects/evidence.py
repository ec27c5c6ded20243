"""What in a scene calls for an effect, in words that name it. Pure functions of census and bundle facts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from ..core.effect_names import EffectName
from ..core.scene_records import Census, MaterialFacts, WorldFacts

SHARP = 0.25
"""Roughness up to which metal and glass throw caustics that a viewer would notice."""
LISTED = 4  # names spelt out in one sentence


@dataclass(frozen=True)
class Evidence:
    """called_for: the scene needs it. present: the converted scene holds it. words: what names it."""

    called_for: bool
    present: bool
    words: tuple[str, ...] = ()


WORDS: dict[EffectName, tuple[str, str]] = {
    "indirect": ("indirect light", "no surface reflects light"),
    "refraction": ("refraction", "no material refracts"),
    "caustics": ("caustics", "no sharp metal or glass beside a surface that shows its caustics"),
    "volumes": ("volumes", "no media"),
    "subsurface": ("subsurface", "no material scatters below its surface"),
    "alpha": ("alpha masks", "no material is transparent or cut out"),
    "environment": ("environment light", "the world is dark"),
    "area-lights": ("area lights", "no lamp with a surface"),
    "point-lights": ("point, spot and sun lights", "no point, spot or sun lamp without size"),
    "glow": ("glowing surfaces", "no material emits"),
    "hair": ("hair strands", "no strands"),
    "depth-of-field": ("depth of field", "no camera in use has it"),
    "spectral": ("spectral rendering", "nothing in the converted scene depends on the wavelength"),
    "motion": ("motion blur", "the scene does not ask for it"),
    "view-dependence": ("spherical harmonics of the view", "all surfaces look the same from every side"),
    "depth": ("texture by depth", "all surfaces look the same from every side: their place in the atlas says all"),
    "normal": ("texture by normal", "all surfaces look the same from every side: their place in the atlas says all"),
}
"""Title, and what is said where nothing calls for it."""


def gather(census: Census, bundle: Mapping[str, Sequence[str]], lenses: Sequence[str]) -> dict[EffectName, Evidence]:
    """Evidence by effect name."""
    materials = census.materials
    frozen = f"asked for, but the scene is frozen: {_list([repr(name) for name in census.motion])}"
    motion = (frozen,) if census.motion else ()
    refracting = _where(materials, lambda m: m.refractive, lambda m: f"index {m.ior:.3g}" if m.ior else "")
    result: dict[EffectName, Evidence] = {
        "indirect": _indirect(census),
        "refraction": _held(bundle, "refraction", refracting),
        "caustics": _caustics(materials, bundle),
        "volumes": _held(bundle, "volumes", _volumes(census)),
        "subsurface": _held(bundle, "subsurface", _where(materials, lambda m: m.subsurface)),
        "alpha": _held(bundle, "alpha", _where(materials, lambda m: m.transparent)),
        "environment": _held(bundle, "environment", _world(census.world)),
        "area-lights": _held(bundle, "area-lights", _lamps(census, sized=True)),
        "point-lights": _held(bundle, "point-lights", _lamps(census, sized=False)),
        "glow": _held(bundle, "glow", _where(materials, lambda m: m.emissive)),
        "hair": _held(bundle, "hair", tuple(f"'{name}'" for name in census.hair)),
        "depth-of-field": _lenses(census, lenses),
        "spectral": _held({}, "spectral", _where(materials, lambda m: m.thin_film)),
        "motion": Evidence(False, False, motion),
    }
    shiny = [f"'{n}'" for n, m in materials.items() if m.glossy or m.transmissive or m.view_dependent]
    glossy = (f"{len(shiny)} materials are not matt: {_list(shiny)}",) if shiny else ()
    result["view-dependence"] = Evidence(bool(glossy), True, glossy)
    shared = census.instances > census.meshes
    extra = (("instances share one place in the atlas",) if shared else ()) + glossy
    result["depth"] = result["normal"] = Evidence(bool(extra), True, extra)
    return result


def _held(bundle: Mapping[str, Sequence[str]], name: str, words: tuple[str, ...]) -> Evidence:
    """An effect that is on where the bundle holds it."""
    held = tuple(bundle.get(name, ()))
    if held:
        return Evidence(True, True, words or (_list([f"'{identity}'" for identity in held]),))
    if words:
        return Evidence(False, False, ("not in the converted scene, see `dnrpipe inspect`", *words))
    return Evidence(False, False)


def _where(
    materials: Mapping[str, MaterialFacts],
    wanted: Callable[[MaterialFacts], object],
    detail: Callable[[MaterialFacts], str] = lambda entry: "",
) -> tuple[str, ...]:
    """A sentence for each material that fits: its name, what is special, the objects that show it."""
    words = []
    for name, entry in materials.items():
        if not wanted(entry):
            continue
        shown = f"on {_list([repr(name) for name in entry.objects])}" if entry.objects else ""
        said = [part for part in (detail(entry), shown) if part]
        words.append(f"material '{name}'" + (f" ({'; '.join(said)})" if said else ""))
    return tuple(words)


def _list(names: Sequence[str]) -> str:
    more = len(names) - LISTED
    return ", ".join(names[:LISTED]) + (f" and {more} more" if more > 0 else "")


def _with_roughness(entry: MaterialFacts) -> str:
    return "roughness by image" if entry.min_roughness is None else f"roughness {entry.min_roughness:.2g}"


def _indirect(census: Census) -> Evidence:
    materials = census.materials
    count = sum(bool(entry.reflects) for entry in materials.values()) + bool(census.default_material)
    if not count:
        return Evidence(False, False)
    passing = [name for name, entry in materials.items() if entry.transparent or entry.transmissive]
    words = f"{count} material{'s' if count > 1 else ''} reflect light"
    if passing:
        words += f"; {_list([repr(name) for name in passing])} let it pass"
    return Evidence(True, True, (words,))


def _caustics(materials: Mapping[str, MaterialFacts], bundle: Mapping[str, Sequence[str]]) -> Evidence:
    def throws(entry: MaterialFacts) -> bool:
        sharp = entry.roughness_linked or (entry.min_roughness is not None and entry.min_roughness <= SHARP)
        return bool(sharp and (entry.metallic or entry.refractive))

    def shows(entry: MaterialFacts) -> bool:
        mirror = entry.metallic or entry.refractive
        return bool(entry.reflects and not (mirror and throws(entry)))

    words = _where(materials, throws, _with_roughness)
    if not words or not any(shows(entry) for entry in materials.values()):
        return Evidence(False, False)
    # Mitsuba's path tracer for media has no way to leave them out.
    return Evidence(True, not bundle.get("volumes"), words)


def _volumes(census: Census) -> tuple[str, ...]:
    words = list(_where(census.materials, lambda m: m.volume))
    words += [f"'{name}'" for name in census.volumes if name not in census.materials]
    if census.world and census.world.volume:
        words.append(f"world '{census.world.name}'")
    return tuple(words)


def _world(world: WorldFacts | None) -> tuple[str, ...]:
    if not world or not world.emits:
        return ()
    what = {"hdri": f"image '{world.image}'", "sky": "sky", "color": "plain colour"}.get(world.kind, "nodes")
    return (f"world '{world.name}' ({what})",)


def _lamps(census: Census, *, sized: bool) -> tuple[str, ...]:
    words = []
    for lamp in census.lights:
        largest = max(lamp.size) if isinstance(lamp.size, tuple) else lamp.size
        if lamp.power and (largest > 0) == sized:
            words.append(f"{lamp.type.lower()} lamp '{lamp.name}'")
    return (_list(words),) if words else ()


def _lenses(census: Census, lenses: Sequence[str]) -> Evidence:
    if lenses:
        return Evidence(True, True, (f"camera {_list([repr(name) for name in lenses])}",))
    if not census.depth_of_field:
        return Evidence(False, False)
    named = _list([repr(name) for name in census.depth_of_field])
    return Evidence(False, False, (f"camera {named} has it, but the views in use are not its own",))
