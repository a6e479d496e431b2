"""Normal equations of a Jacobian most of whose entries are zero: parameters of one recording among many."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Floats
from icrtool.kernels.compiled import njit


@njit
def weighted_products(jacobian: Floats, weights: Floats, residuals: Floats, matrix: Floats, vector: Floats) -> None:
    """Fill J^T W J (k, k) and J^T W r (k,) of a Jacobian (m, k), weights and residuals (m,); zeros are skipped."""
    m, k = jacobian.shape
    some = np.empty(k, np.int64)
    matrix[:] = 0.0
    vector[:] = 0.0
    for i in range(m):
        count = 0
        for a in range(k):
            if jacobian[i, a] != 0.0:
                some[count] = a
                count += 1
        for p in range(count):
            a = some[p]
            pulled = weights[i] * jacobian[i, a]
            vector[a] += pulled * residuals[i]
            for q in range(p + 1):
                matrix[a, some[q]] += pulled * jacobian[i, some[q]]
    for a in range(k):
        for b in range(a):
            matrix[b, a] = matrix[a, b]
