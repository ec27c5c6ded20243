"""``dnr_camera``: a pinhole or thin lens whose pixels need not be square.

Mitsuba's ``perspective`` and ``thinlens`` have one field of view for both axes, and ``thinlens`` no principal point.
"""

from __future__ import annotations

from typing import Any

from .nesting import parameter


def register(mi: Any) -> None:
    """``dnr_camera`` for the current variant."""
    import drjit as dr

    class Camera(mi.Sensor):
        """Looks along +Z of ``to_world`` with +X left and +Y up, as Mitsuba's sensors do.

        ``fl_x``, ``fl_y``: focal lengths; ``cx``, ``cy``: principal point from the film's top left corner; in pixels.
        ``aperture_radius`` (0: a pinhole), ``focus_distance`` along the axis: lengths of the scene.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            width, height = self.film().size()
            # In units of the film's sides, in which positions are given; signs are those of camera space.
            scales = -width / props["fl_x"], -height / props["fl_y"]
            offsets = props["cx"] / props["fl_x"], props["cy"] / props["fl_y"]
            self.scale, self.offset = (
                mi.Vector2f(*(parameter(mi, float(value)) for value in pair)) for pair in (scales, offsets)
            )
            radius = float(props.get("aperture_radius", 0.0))
            self.has_lens = radius > 0
            self.radius, self.focus = (
                parameter(mi, value) for value in (radius, float(props.get("focus_distance", 1.0)))
            )
            self.m_needs_sample_3 = self.has_lens

        def sample_ray(
            self, time: Any, wavelength_sample: Any, position_sample: Any, aperture_sample: Any, active: Any = True
        ) -> tuple[Any, Any]:
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength_sample, active)
            place = position_sample * self.scale + self.offset
            direction, aside = mi.Vector3f(place.x, place.y, 1), mi.Vector3f(0)
            if self.has_lens:
                disk = mi.warp.square_to_uniform_disk_concentric(aperture_sample) * self.radius
                aside = mi.Vector3f(disk.x, disk.y, 0)
                direction = direction * self.focus - aside
            world = self.world_transform()
            origin = world @ mi.Point3f(aside)
            return mi.Ray3f(origin, dr.normalize(world @ direction), time, wavelengths), weight

        def sample_ray_differential(
            self, time: Any, wavelength_sample: Any, position_sample: Any, aperture_sample: Any, active: Any = True
        ) -> tuple[Any, Any]:
            ray, weight = self.sample_ray(time, wavelength_sample, position_sample, aperture_sample, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self) -> Any:
            place = self.world_transform() @ mi.Point3f(0)
            return mi.BoundingBox3f(place, place)

        def to_string(self) -> str:
            return "dnr_camera[]"

    mi.register_sensor("dnr_camera", Camera)
