"""Objects that only some kinds of rays see. Mitsuba knows no ray kinds, so each becomes a finding."""

from __future__ import annotations

from collections.abc import Iterable

import bpy

from ..findings import Findings

KINDS = {
    "visible_diffuse": "diffuse",
    "visible_glossy": "glossy",
    "visible_transmission": "transmission",
    "visible_volume_scatter": "volume scatter",
    "visible_shadow": "shadow",
}


def report_ray_visibility(names: Iterable[str], findings: Findings) -> None:
    """A finding for each object that is hidden from some rays, a shadow catcher, a holdout, or has linked light.

    names: objects of the frozen scene. Visibility to camera rays is converted, and is no finding.
    """
    objects = {obj.name_full: obj for obj in bpy.data.objects}
    for name in sorted(set(names) & set(objects)):
        obj = objects[name]
        hidden = [kind for flag, kind in KINDS.items() if not getattr(obj, flag, True)]
        if hidden:
            findings.add("ignored", "ray visibility", f"{', '.join(hidden)} rays see it", object=name)
        if obj.is_shadow_catcher:
            findings.add("ignored", "shadow catcher", "an ordinary surface", object=name)
        if obj.is_holdout:
            findings.add("ignored", "holdout object", "an ordinary surface", object=name)
        linking = getattr(obj, "light_linking", None)
        if linking is not None and (linking.receiver_collection or linking.blocker_collection):
            findings.add("ignored", "light linking", "it lights and shades everything", object=name)
