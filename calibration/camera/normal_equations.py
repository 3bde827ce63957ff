"""Normal equations whose poses are eliminated image by image: Schur's complement.

The unknowns are the shared ones s, lens and warp, and for each image i a small motion f_i of its board in the
camera frame. With J the derivatives of the image points over their sigma and e the residuals over theirs:

    H = [[A, B_1, B_2, ...], [B_1', D_1, 0, ...], [B_2', 0, D_2, ...], ...],   g = J' e
    S = A - sum B_i D_i^-1 B_i',   S ds = g_s - sum B_i D_i^-1 g_i,   D_i df_i = g_i - B_i' ds

(Triggs et al., Bundle adjustment - a modern synthesis, 2000, section 6.1). S is the information on what is
shared: its inverse is the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from noise_model.compiled.arrays import Float64


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal equations, image by image.

    `shared` (V, m, m) are each image's part of A, `mixed` (V, m, 6) is B_i, `motion` (V, 6, 6) is D_i;
    `gradient_shared` (V, m) are parts of g_s, `gradient_motion` (V, 6) is g_i. `precision` and
    `gradient_prior` (m,) are what a normal prior adds to the diagonal of S and to the right side of S ds; 0
    without one.
    """

    shared: Float64
    mixed: Float64
    motion: Float64
    gradient_shared: Float64
    gradient_motion: Float64
    precision: Float64 | float = 0.0
    gradient_prior: Float64 | float = 0.0

    @classmethod
    def of(
        cls, slices: list[slice], per_shared: Float64, per_motion: Float64, residual: Float64
    ) -> NormalEquations:
        """Sum over the corners of each image, which `slices` selects.

        `per_shared` (N, 2, m) and `per_motion` (N, 2, 6) are derivatives of the image points, `residual` (N,
        2) is observed less predicted, all over sigma.
        """
        m = per_shared.shape[2]
        rows = np.concatenate([per_shared, per_motion, residual[:, :, None]], axis=2)
        blocks = [rows[part].reshape(-1, m + 7) for part in slices]
        squares = np.stack([block.T @ block for block in blocks])
        return cls(
            squares[:, :m, :m],
            squares[:, :m, m : m + 6],
            squares[:, m : m + 6, m : m + 6],
            squares[:, :m, -1],
            squares[:, m : m + 6, -1],
        )

    def damped(self, damping: float) -> NormalEquations:
        """Return them with each diagonal raised by a share: Levenberg's and Marquardt's step."""
        motion, total = self.motion.copy(), np.diag(self.shared.sum(axis=0)) + self.precision
        motion[:, range(6), range(6)] *= 1.0 + damping
        return replace(self, motion=motion, precision=self.precision + damping * total)

    def with_prior(self, precision: Float64, value: Float64) -> NormalEquations:
        """Return them with a normal prior about 0 on the shared unknowns.

        `precision` (m,) is 1 / sigma² of each, 0 where nothing is known; `value` (m,) is each now.
        """
        return replace(self, precision=precision, gradient_prior=-precision * value)

    def view_information(self) -> Float64:
        """Return each image's part (V, m, m) of S."""
        solved = np.linalg.solve(self.motion, self.mixed.transpose(0, 2, 1))
        return np.asarray(self.shared - self.mixed @ solved)

    def information(self) -> Float64:
        """Return S (m, m), the information on what is shared, with that of the prior."""
        total = np.asarray(self.view_information().sum(axis=0))
        total[np.diag_indices_from(total)] += self.precision
        return total

    def view_gradients(self) -> Float64:
        """Return each image's part (V, m) of the right side of S ds."""
        eliminated = np.linalg.solve(self.motion, self.gradient_motion[:, :, None])
        return np.asarray(self.gradient_shared - (self.mixed @ eliminated)[:, :, 0])

    def pull(self) -> Float64:
        """Return the right side (m,) of S ds, with the prior's part."""
        return np.asarray(self.view_gradients().sum(axis=0) + self.gradient_prior)

    def step(self) -> tuple[Float64, Float64]:
        """Return the step of what is shared (m,) and of each image's board (V, 6).

        Raises numpy.linalg.LinAlgError where they are singular.
        """
        shared = scaled_inverse(self.information()) @ self.pull()
        pulled = self.gradient_motion - np.einsum("vmk,m->vk", self.mixed, shared)
        return shared, np.linalg.solve(self.motion, pulled[:, :, None])[:, :, 0]

    def motion_step(self) -> Float64:
        """Return the step of each image's board (V, 6) with lens and warp held."""
        return np.asarray(np.linalg.solve(self.motion, self.gradient_motion[:, :, None])[:, :, 0])


def scaled_inverse(matrix: Float64) -> Float64:
    """Return the inverse of a positive matrix whose rows have units of their own.

    Raises numpy.linalg.LinAlgError if it is singular.
    """
    diagonal = np.diag(matrix)
    if not (diagonal > 0.0).all():
        raise np.linalg.LinAlgError("an unknown is not seen at all")
    scale = 1.0 / np.sqrt(diagonal)
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(0.5 * (inverse + inverse.T))
