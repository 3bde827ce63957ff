"""The certificate: what the seam's absolute position is good for, and what would make it better."""

from collections.abc import Mapping

import numpy as np

from arctrack.calibrate.page import CalibrationPage, PagePicture, ValueRow
from arctrack.report import style
from arctrack.report.embedded import svg
from calibration.certificate import CAMERA, DELAY, HAND_EYE, LASER, LATERAL, ROBOT, VERTICAL, Certificate
from noise_model.compiled.arrays import Float64

TITLE = "arctrack certifies what the seam's absolute position is good for"

COVER = 2.0
"""The interval that is certified, in sigmas: that of EA-4/02 and other guides to certificates."""

SOURCES = {
    CAMERA: ("lens", "more board images, nearer to the corners and tilted otherwise"),
    LASER: ("laser sheet", "more pairs, with the board nearer to the camera and farther away"),
    HAND_EYE: ("camera's pose, by the images", "sharper and larger boards at the robot's poses"),
    ROBOT: ("camera's pose, by the robot", "more robot poses, turned farther about all axes"),
    DELAY: ("delay of the poses", "`arctrack calibrate delay` on a recording that weaves more"),
}
"""Sources of the covariance, with what reduces their share."""


def certificate_page(
    certificate: Certificate | None, unmeasured: Mapping[str, str], refused: Mapping[str, str]
) -> CalibrationPage:
    """Return the certificate's page.

    The certificate is None where the laser sheet was not measured. `unmeasured` says what it takes as stated,
    `refused` why calibrations were refused.
    """
    notes = [f"{what}: {text}" for what, text in unmeasured.items()]
    notes += [f"{name} is refused: {why}" for name, why in refused.items()]
    mark = "unknown" if refused or certificate is None else "ambiguous" if unmeasured else "no_gap"
    if certificate is None:
        without = "The seam's position follows from the laser sheet, which was not measured."
        headline = "no certificate"
        return CalibrationPage(
            title=TITLE,
            label="certificate",
            headline=headline,
            sentences=(without,),
            notes=tuple(notes),
            mark=mark,
        )
    n, worst = certificate.nearest_to_tool, certificate.worst
    lateral, vertical = (certificate.sigma_mm[n, axis] for axis in (LATERAL, VERTICAL))
    total = certificate.across_sigma_mm
    what, cure = SOURCES[certificate.weakest]
    rest = certificate.without(certificate.weakest)
    field = certificate.points_tool_mm
    sentences = (
        f"That is {COVER:g} σ of the calibration at the point of the laser sheet nearest to the tool's "
        f"axis. At the worst point it is ± {COVER * certificate.sigma_mm[worst, LATERAL]:.2f} mm lateral and "
        f"± {COVER * certificate.sigma_mm[worst, VERTICAL]:.2f} mm vertical. "
        "The sheet was judged where the pairs show it, from "
        f"{field[:, LATERAL].min():.0f} to {field[:, LATERAL].max():.0f} mm across the seam and from "
        f"{field[:, VERTICAL].min():.0f} to {field[:, VERTICAL].max():.0f} mm in height.",
        f"The largest share is that of the {what}. Were it exact, 1 σ across the seam at the worst point "
        f"would be {rest:.3f} mm in place of {total[worst]:.3f} mm. To get there: {cure}.",
        "It holds for the seam point in the tool, in which a correction is given. The tool centre "
        "point's own calibration, the robot's path accuracy and the reading of a single frame come on top.",
        *_in_base(certificate),
    )
    return CalibrationPage(
        title=TITLE,
        label="certificate",
        headline=f"± {COVER * lateral:.2f} mm lateral, ± {COVER * vertical:.2f} mm vertical",
        sentences=sentences,
        rows=_rows(certificate),
        pictures=(
            PagePicture(
                _map(certificate),
                "1 σ of the calibration over the laser sheet",
                "The cross is the point nearest to the tool's axis.",
            ),
        ),
        notes=tuple(notes),
        mark=mark,
        heads=("1 σ lateral / vertical", "at the worst point", "share there"),
    )


def _in_base(certificate: Certificate) -> tuple[str, ...]:
    """Return what the robot's error adds to a seam in base coordinates; nothing where it is unknown."""
    pose_mm = COVER * certificate.pose_sigma_mm[certificate.nearest_to_tool]
    if not pose_mm.any():
        return ()
    lateral, vertical = np.hypot(pose_mm, COVER * certificate.sigma_mm[certificate.nearest_to_tool])[1:]
    return (
        f"In base coordinates, as of a seam that is stored, the error of the robot's pose comes on top: "
        f"± {pose_mm[LATERAL]:.2f} mm lateral and ± {pose_mm[VERTICAL]:.2f} mm vertical, together "
        f"± {lateral:.2f} and ± {vertical:.2f} mm.",
    )


def _rows(certificate: Certificate) -> tuple[ValueRow, ...]:
    n, worst = certificate.nearest_to_tool, certificate.worst
    total = certificate.across_sigma_mm[worst] ** 2

    def row(what: str, sigma_mm: Float64) -> ValueRow:
        near, far = (f"{sigma_mm[k, LATERAL]:.3f} / {sigma_mm[k, VERTICAL]:.3f}" for k in (n, worst))
        share = (sigma_mm[worst, LATERAL] ** 2 + sigma_mm[worst, VERTICAL] ** 2) / total
        return ValueRow(what, "", near, far, f"{100.0 * share:.0f} %", "mm")

    shares = {source: certificate.share_sigma_mm(source) for source in certificate.shares_mm2}
    return (
        *(row(SOURCES[source][0], sigma_mm) for source, sigma_mm in shares.items() if sigma_mm.any()),
        row("all together", certificate.sigma_mm),
    )


def _map(certificate: Certificate) -> str:
    figure = style.new_figure(10.5, 4.4, "")
    points = certificate.points_tool_mm
    for axes, axis, name in zip(
        figure.subplots(1, 2), (LATERAL, VERTICAL), ("lateral", "vertical"), strict=True
    ):
        style.plain(axes, "across the seam, y [mm]", "height, z [mm]", name)
        shown = axes.tricontourf(points[:, LATERAL], points[:, VERTICAL], certificate.sigma_mm[:, axis], 12)
        axes.plot(*points[certificate.nearest_to_tool, [LATERAL, VERTICAL]], "x", color="white")
        figure.colorbar(shown, ax=axes, label="1 σ [mm]")
    return svg(figure)
