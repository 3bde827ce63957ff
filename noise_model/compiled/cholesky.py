"""Normal equations of a few unknowns, solved in a kernel by Cholesky's factor.

numba calls LAPACK for these, by fifteen functions of its own that take two seconds to compile.
"""

from __future__ import annotations

from noise_model.compiled.arrays import Float64
from noise_model.compiled.kernel import kernel


@kernel
def factorise(H: Float64) -> bool:
    """Turn a symmetric matrix (m, m) into its lower factor L, H = L L^T; False if it is not positive."""
    for j in range(H.shape[0]):
        for i in range(j, H.shape[0]):
            rest = H[i, j]
            for k in range(j):
                rest -= H[i, k] * H[j, k]
            if i > j:
                H[i, j] = rest / H[j, j]
            elif rest > 0.0:
                H[j, j] = rest**0.5
            else:
                return False
    return True


@kernel
def solve(L: Float64, b: Float64) -> None:
    """Turn the right side b (m,) into x of L L^T x = b."""
    m = b.shape[0]
    for i in range(m):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@kernel
def write_inverse(L: Float64, inverse: Float64) -> None:
    """Write the inverse (m, m) of L L^T."""
    for j in range(L.shape[0]):
        for i in range(L.shape[0]):
            inverse[j, i] = 1.0 if i == j else 0.0
        solve(L, inverse[j])
