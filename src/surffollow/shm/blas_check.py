"""Load numba's array functions without scipy.linalg, which costs every start 0.15 s of processor time.

numba imports scipy.linalg to know whether `np.dot` in a kernel can use BLAS, on loading the first kernel
whether or not any kernel uses it. The answer is taken for granted here, because scipy is required; numba's
own check is in place again afterwards and runs when a kernel with linear algebra is compiled.
"""

from __future__ import annotations

from numba.np import linalg

_check = linalg.ensure_blas
setattr(linalg, "ensure_blas", lambda: None)  # noqa: B010 - a name of an untyped module
try:
    from numba.np import arraymath as arraymath
finally:
    setattr(linalg, "ensure_blas", _check)  # noqa: B010
