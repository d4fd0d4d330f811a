"""The incremental solver of the pose graph, as it is set up here."""

import gtsam


def new_isam(factorization: str) -> gtsam.ISAM2:
    """Return an empty ISAM2 that factorises by `QR` or `CHOLESKY`."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization(factorization)
    parameters.setRelinearizeThreshold(0.02)
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True  # memory stays with what is active
    return gtsam.ISAM2(parameters)
