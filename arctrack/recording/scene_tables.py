"""The scene's tables of recording.toml: arc, metal, joint, and how well the setup is known.

The physics is imported once the keys are right: it takes seconds, and a misspelt key needs none of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from arctrack.limits import LIMITS, source_of
from arctrack.recording.key_errors import held, meant_by
from arctrack.recording.schema import MAX_NUMBER, Bounds, Key, Table, key, within
from arctrack.recording.sensor_tables import IN_TOOL, Number, PointInTool, Vector3
from noise_model.arc_source import Arc
from noise_model.setup_keys import DIMENSIONS, OPTIONAL_DIMENSIONS, Tolerance

if TYPE_CHECKING:
    from noise_model.surface.joint import Joint

InBase = Annotated[float, within(Bounds(-LIMITS.length_mm, LIMITS.length_mm, source_of("length_mm")))]
PointInBase = Annotated[list[InBase], Field(min_length=3, max_length=3)]


PointInSection = Annotated[list[Annotated[float, within(IN_TOOL)]], Field(min_length=2, max_length=2)]


class ArcTable(Table):
    """The arc; a sensor that sees none leaves it out."""

    shape: str = key("The arc's shape; hemisphere is the only one", "", "hemisphere", "your choice.")
    radius_mm: float = key(
        "Radius of the arc's bright half sphere",
        "mm",
        "1.5 to 5",
        "a picture. Of the arc through a dark filter, with the electrode's diameter as the scale. `arctrack "
        "calibrate arc` finds it from frames of the arc alone.",
        bounds=Bounds(None, 1000.0, "an arc is a few mm wide"),
    )
    center_in_tool_mm: PointInTool = key(
        "The half sphere's centre: x, y, z in the tool frame",
        "mm",
        "within 3 of the origin",
        "a ruler or the drawing. The origin, where the arc burns on the part's surface. On a lap it stands "
        "on the upper sheet. `arctrack calibrate arc` finds it.",
    )
    on_surface: bool = key(
        "Whether the arc's foot stays on the part when the torch is raised", "", "true", "your choice."
    )
    radiance_e: Number = key(
        "How bright the arc is to this camera",
        "e-",
        "1e6 to 1e10",
        "a guess. Leave it, replay a recording, and multiply it by the median of `arc_level` in "
        "results.csv; or `arctrack calibrate arc`.",
    )
    current_a: float = key(
        "The welding current at which radiance_e holds",
        "A",
        "50 to 300",
        "your choice. As set on the power source. frames.csv states that of each frame.",
        bounds=Bounds(0.001, LIMITS.current_a, f"ratios of currents stay finite; {source_of('current_a')}"),
    )
    current_exponent: float = key(
        "The light goes with the current to this power",
        "",
        "1 to 2",
        "a guess. Of the arc's light at two currents: the ratio's logarithm over that of the currents.",
        bounds=Bounds(-10.0, 10.0, "measured arcs show 0.8 to 2"),
    )

    def to_arc(self) -> Arc:
        """Return the arc; ValueError names the key of a value that cannot be."""
        if not self.radiance_e > 0.0:
            raise ValueError(f"[arc] radiance_e = {self.radiance_e}: must be > 0; leave [arc] out for no arc")
        return Arc(**{**self.known, "center_in_tool_mm": three(self.center_in_tool_mm)})


class MaterialTable(Table):
    """The base metal's reflectance."""

    name: str = key("The base metal's name", "", "mild_steel", "your choice. For your own use.")
    kappa_diff: Number = key(
        "Diffuse part of the metal's reflectance",
        "",
        "0.02 to 0.6",
        "a calibration. With kappa_spec, c2: mild steel 0.021, 0.326, 112; Zn-coated 0.495, 0.153, 8.3. "
        "Another metal by `arctrack calibrate reflectance` or `arctrack calibrate arc`.",
    )
    kappa_spec: Number = key(
        "Specular part of the metal's reflectance", "", "0.1 to 0.5", "a calibration. As kappa_diff."
    )
    c2: Number = key(
        "How narrow the specular lobe is: large is like a mirror",
        "",
        "5 to 200",
        "a calibration. As kappa_diff.",
    )


def _dimension(meaning: str, unit: str, typical: str, bounds: Bounds = IN_TOOL) -> Any:
    return key(meaning, unit, typical, "a ruler or the drawing.", default=None, bounds=bounds)


class DimensionTable(Table):
    """The dimensions in [joint]; which of them are needed, and read, depends on the joint's type."""

    included_angle_deg: float | None = _dimension("The angle between the two faces", "deg", "30 to 120")
    bevel_angle_deg: float | None = _dimension("A bevel's angle from upright", "deg", "10 to 60")
    depth_mm: float | None = _dimension("The groove's depth", "mm", "1 to 30")
    root_gap_mm: float | None = _dimension("The gap at the root", "mm", "0 to 4")
    root_radius_mm: float | None = _dimension("The root's rounding", "mm", "1 to 10")
    thickness_mm: float | None = _dimension(
        "A sheet's thickness, of a lap the upper one's", "mm", "0.8 to 10"
    )
    gap_mm: float | None = _dimension("The gap between the plates", "mm", "0 to 3")
    pitch_mm: float | None = _dimension(
        "From one crest to the next",
        "mm",
        "20 to 200",
        Bounds(1.0, IN_TOOL.high, f"corrugated sheets show 10 to 300; {IN_TOOL.source}"),
    )
    height_mm: float | None = _dimension("The crests' height", "mm", "2 to 50")
    width_mm: float | None = _dimension("A crest's width at its foot", "mm", "10 to the pitch")


class JointTable(Table):
    """The joint and its nominal seam; the type says which dimensions it has."""

    extra_keys = DimensionTable

    @property
    def names(self) -> set[str]:
        """Its keys and its type's dimensions; of a type that there is not, none is unknown."""
        needed = DIMENSIONS.get(self.type, self.model_extra or {})
        return super().names | {*needed, *OPTIONAL_DIMENSIONS.get(self.type, ())}

    type: str = key(
        "The joint: v_groove, half_v, u_groove, lap, corrugation, butt, fillet, edge, outside_corner, free "
        "or flat",
        "",
        "v_groove",
        "your choice. Each type has dimensions of its own.",
    )
    seam_in_base_mm: list[PointInBase] = key(
        "The programmed seam in the base frame, from the start of the travel to its end: points x, y, z",
        "mm",
        "20 to 5000 long",
        "a ruler or the drawing. Two points are enough for a straight seam: those that the robot was taught.",
    )
    surface_normal_in_base: Vector3 = key(
        "The direction away from the part, in the base frame; length 1",
        "",
        "length 1",
        "a ruler or the drawing. [0, 0, 1] for a plate that lies flat in a base whose z is up.",
    )
    surface_normals_in_base: list[Vector3] | None = key(
        "The same at each point of seam_in_base_mm, where it turns along the seam, as round a pipe",
        "",
        "each of length 1",
        "the drawing: of a fillet round an upright pipe half up, half away from the pipe.",
        default=None,
        example="[[0.0, -0.7071, 0.7071], [0.7071, 0.0, 0.7071]]",
    )

    section_mm: list[PointInSection] | None = key(
        "Of a free joint its section: points y, z from the right of the travel to its left, the seam at 0, 0",
        "mm",
        "10 to 32 points",
        "a profile that was measured: `arctrack explain --section` prints that of a frame.",
        default=None,
    )

    def to_joint(self) -> Joint:
        """Return the joint; ValueError names the key of a value that cannot be."""
        from noise_model.surface.joint import Joint

        normals = self.surface_normals_in_base
        return Joint(
            type=self.type,
            dimensions=self.dimensions(),
            seam_in_base_mm=tuple(three(point) for point in self.seam_in_base_mm),
            surface_normal_in_base=three(self.surface_normal_in_base),
            surface_normals_in_base=None if normals is None else tuple(map(three, normals)),
            section_mm=tuple((float(y), float(z)) for y, z in self.section_mm or ()),
        )

    def dimensions(self) -> dict[str, float]:
        """Return the dimensions that this type of joint needs and the file gives."""
        sizes: dict[str, float] = {}
        needed, optional = DIMENSIONS.get(self.type, ()), OPTIONAL_DIMENSIONS.get(self.type, ())
        for name in (*needed, *optional):
            extras = self.model_extra or {}
            value = extras.get(name)
            if value is None and name in optional:
                continue
            if value is None:
                hint = meant_by(name, (key for key in extras if key not in needed))
                raise ValueError(f"[joint] {name}: missing, a {self.type} needs it{hint}")
            low, high, _ = Key("joint", name, DimensionTable.model_fields[name]).bounds
            if low is None or high is None or not (is_number(value) and low <= value <= high):
                raise ValueError(
                    f"{held(f'[joint] {name}', value)}: must be a finite number from {low:g} to {high:g}"
                )
            sizes[name] = float(value)
        return sizes


class ToleranceTable(Table):
    """The uncertainty of the stated setup, and the error that the weld can bear."""

    arc_level_rel: Number = key(
        "How well radiance_e is known: 1 sigma, relative",
        "",
        "0.05 to 0.3",
        "a guess. 0.1 after a first replay.",
        default=Tolerance.arc_level_rel,
    )
    laser_level_rel: Number = key(
        "How well peak_e is known: 1 sigma, relative",
        "",
        "0.02 to 0.2",
        "a guess.",
        default=Tolerance.laser_level_rel,
    )
    hand_eye_deg: Number = key(
        "How well the camera's rotation is known: 1 sigma about each axis",
        "deg",
        "0.02 to 0.5",
        "a calibration. The residual of the hand-eye calibration. It limits the confidence that a track can "
        "have. `[calibration.geometry]`, which `arctrack calibrate all` writes, counts in its place.",
        default=Tolerance.hand_eye_deg,
    )
    hand_eye_mm: Number = key(
        "How well the camera's place is known: 1 sigma along each axis",
        "mm",
        "0.02 to 0.5",
        "a calibration. As hand_eye_deg.",
        default=Tolerance.hand_eye_mm,
    )
    black_level_dn: Number = key(
        "How well the black level is known: 1 sigma",
        "DN",
        "0.1 to 1",
        "a picture. Its drift between a cold and a warm camera.",
        default=Tolerance.black_level_dn,
    )
    read_noise_rel: Number = key(
        "How well the read noise is known: 1 sigma, relative",
        "",
        "0.02 to 0.2",
        "a guess.",
        default=Tolerance.read_noise_rel,
    )
    seam_mm: Number = key(
        "What error of the seam the weld can bear",
        "mm",
        "0.1 to 1",
        "your choice. The welding procedure states it. The confidence of a track is asked for it.",
        default=Tolerance.seam_mm,
    )


def is_number(value: Any) -> bool:
    """Return True if a value of a file is a number of a usable size."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER


def three(values: list[float]) -> tuple[float, float, float]:
    """Return a vector of a file as a tuple."""
    return (values[0], values[1], values[2])
