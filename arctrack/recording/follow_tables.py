"""[follow] of recording.toml and of a cell's jobs: what is sent of the seam that was measured."""

from pydantic import Field

from arctrack.recording.schema import Table, key
from arctrack.recording.sensor_tables import Number
from tracker.seam.correction import AtLimit, AxisCorrection, Correction, CorrugationPath, WhenLost


class FollowAxisTable(Table):
    """The correction of an axis, across the seam (y) or of height (z); without a limit the gate bounds it."""

    enable: bool = key(
        "Whether the axis is corrected",
        default=AxisCorrection.enable,
        example="false",
        note="false sends it as unknown: the robot may then not correct it, as where the arc-voltage "
        "control has the height, and the gate ignores it.",
    )
    gain: Number = key(
        "The share of the displacement that is followed, above 0, at most 1", default=AxisCorrection.gain
    )
    bias_mm: Number = key(
        "What is added after the gain: positive to the left, out of the part",
        "mm",
        default=AxisCorrection.bias_mm,
    )
    limit_mm: Number | None = key(
        "The most that is sent to either side, bias included", "mm", default=None, example="3.0"
    )
    at_limit: AtLimit = key(
        "What is done beyond the limit",
        default=AxisCorrection.at_limit,
        note='"saturate" sends the limit, flag offset_limited; "stop" stops following.',
    )

    def to_axis(self, place: str) -> AxisCorrection:
        """Return the axis; ValueError names `place` and the key of a value that cannot be."""
        values = {name: value for name, value in self.known.items() if value is not None}
        try:
            return AxisCorrection(**values)
        except ValueError as error:
            raise ValueError(f"[{place}] {error}") from None


class FollowTable(Table):
    """The correction that follows from the measured seam."""

    when_lost: WhenLost = key(
        "What is sent past the last measurement",
        default=Correction.when_lost,
        note='"hold" sends the last place, "extrapolate" the expected one, "stop" nothing any more.',
    )
    extrapolate_mm: Number = key(
        "How far past it hold and extrapolate go", "mm", default=Correction.extrapolate_mm
    )
    extrapolate_sigma_mm: Number = key(
        "The largest 1 sigma of a known offset", "mm", default=Correction.extrapolate_sigma_mm
    )
    ends_mm: Number = key(
        "How far the joint's ends may lie from the seam line's, searched above 0",
        "mm",
        default=Correction.ends_mm,
    )
    corrugation: CorrugationPath = key(
        "Whether the programmed path goes over a corrugation",
        default=Correction.corrugation,
        note='"followed" says that it is flat: z gets the sheet\'s drawn height at the torch as well, '
        "whatever the gain; it counts towards the limit.",
    )
    y: FollowAxisTable = Field(default_factory=FollowAxisTable)
    z: FollowAxisTable = Field(default_factory=FollowAxisTable)

    def to_correction(self) -> Correction:
        """Return the correction; ValueError names the table and key of a value that cannot be."""
        axes = {"y": self.y.to_axis("follow.y"), "z": self.z.to_axis("follow.z")}
        return Correction(**{**self.known, **axes})
