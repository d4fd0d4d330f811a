"""Records of the ledger as factors of gtsam, and estimates as its values."""

from collections.abc import Callable, Mapping

import gtsam
import numpy as np

from firmware.geometry import Array
from firmware.leader.ledger import (
    QUARTER_TURN,
    AbsoluteRecord,
    Anchor,
    ClosureRecord,
    OdometryRecord,
    PriorRecord,
    RangeRecord,
    Record,
    SharedDriftRecord,
    SharedWalkRecord,
)

_BIAS = np.eye(2, 4, 2)  # takes a node's state to its bias
_Jacobians = list[Array] | None


def factor_of(  # noqa: PLR0911
    record: Record, robust_kernel: float
) -> gtsam.NonlinearFactor:
    """Return the factor that gtsam makes of a record; closures and ranges are robust."""
    match record:
        case PriorRecord():
            noise = gtsam.noiseModel.Diagonal.Sigmas(record.sigmas)
            return gtsam.PriorFactorVector(record.key, record.mean, noise)
        case OdometryRecord():
            return _odometry(record)
        case SharedDriftRecord():
            return _shared_drift(record)
        case SharedWalkRecord():
            return _shared_walk(record)
        case ClosureRecord():
            return _closure(record, _robust(record.covariance_m2, robust_kernel))
        case RangeRecord():
            return _range(record, _robust(np.array([[record.sigma_m**2]]), robust_kernel))
        case AbsoluteRecord():
            return _absolute(record, _robust(record.covariance_m2, robust_kernel))


def values_of(estimate: Mapping[int, Array]) -> gtsam.Values:
    """Return the states of variables by their keys as gtsam's values."""
    values = gtsam.Values()
    for key, state in estimate.items():
        values.insert(key, state)
    return values


def _robust(covariance: Array, robust_kernel: float) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(robust_kernel),
        gtsam.noiseModel.Gaussian.Covariance(covariance),
    )


def _odometry(record: OdometryRecord) -> gtsam.NonlinearFactor:
    """Return the linear factor of OdometryRecord, stated at the origin of the state space."""
    from_origin, from_target = -np.eye(4), np.eye(4)
    from_origin[:2, 2:] = from_target[:2, 2:] = 0.5 * record.interval_s * np.eye(2)
    from_parameters = np.zeros((4, 2))
    from_parameters[:2, 0] = QUARTER_TURN @ record.moved_m
    from_parameters[:2, 1] = record.moved_m
    right = np.concatenate([record.moved_m, np.zeros(2)])
    sigmas = np.repeat([record.position_sigma_m, record.bias_sigma_mps], 2)
    zero = gtsam.Values()
    zero.insert(record.origin, np.zeros(4))
    zero.insert(record.target, np.zeros(4))
    zero.insert(record.parameters, np.zeros(2))
    linear = gtsam.JacobianFactor(
        record.target,
        from_target,
        record.origin,
        from_origin,
        record.parameters,
        from_parameters,
        right,
        gtsam.noiseModel.Diagonal.Sigmas(sigmas),
    )
    return gtsam.LinearContainerFactor(linear, zero)


def _shared_drift(record: SharedDriftRecord) -> gtsam.NonlinearFactor:
    keys = [record.origin, record.target]

    def error(_this: object, values: gtsam.Values, jacobians: _Jacobians) -> Array:
        if jacobians is not None:
            jacobians[0], jacobians[1] = -_BIAS, _BIAS
        return np.asarray(values.atVector(keys[1])[2:] - values.atVector(keys[0])[2:])

    return _custom(gtsam.noiseModel.Isotropic.Sigma(2, record.sigma_mps), keys, error)


def _shared_walk(record: SharedWalkRecord) -> gtsam.NonlinearFactor:
    keys = [*record.origins, *record.targets]
    signs = (1.0, -1.0, -1.0, 1.0)

    def error(_this: object, values: gtsam.Values, jacobians: _Jacobians) -> Array:
        if jacobians is not None:
            for k, sign in enumerate(signs):
                jacobians[k] = sign * _BIAS
        one, other, one_later, other_later = map(values.atVector, keys)
        return np.asarray((one - other - one_later + other_later)[2:])

    return _custom(gtsam.noiseModel.Isotropic.Sigma(2, record.sigma_mps), keys, error)


def _custom(
    noise: gtsam.noiseModel.Base, keys: list[int], error: Callable[..., Array]
) -> gtsam.NonlinearFactor:
    return gtsam.CustomFactor(noise, keys, error)


def _closure(record: ClosureRecord, noise: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
    """Return a factor of two nodes and of the parameters of one vehicle, or of two.

    Its innovation is linear, but its noise is robust, so that gtsam has no factor of its own.
    """
    way = _Way(record.origin, record.target)

    def error(_this: object, values: gtsam.Values, jacobians: _Jacobians) -> Array:
        if jacobians is not None:
            for k, block in enumerate(way.blocks):
                jacobians[k] = block
        return np.asarray(way.moved_m(values) - record.offset_m)

    return _custom(noise, way.keys, error)


def _range(record: RangeRecord, noise: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
    """Return a factor of a closure's variables, and of a clock where one is estimated."""
    way = _Way(record.origin, record.target)
    clock = record.clock

    def error(_this: object, values: gtsam.Values, jacobians: _Jacobians) -> Array:
        clock_state = None if clock is None else values.atVector(clock)
        miss_m, direction = record.miss_m(way.moved_m(values), clock_state)
        if jacobians is not None:
            for k, block in enumerate(way.blocks):
                jacobians[k] = (direction @ block)[None, :]
            if clock is not None:
                jacobians[len(way.blocks)] = record.by_clock[None, :]
        return np.array([miss_m])

    return _custom(noise, way.keys if clock is None else [*way.keys, clock], error)


def _absolute(record: AbsoluteRecord, noise: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
    anchor = record.anchor

    def error(_this: object, values: gtsam.Values, jacobians: _Jacobians) -> Array:
        if jacobians is not None:
            jacobians[0], jacobians[1] = anchor.by_state, -anchor.turning
        return record.innovation_m(values.atVector)

    return _custom(noise, [anchor.key, anchor.parameters], error)


class _Way:
    """The way from one anchor to another, linear in the variables on which it depends.

    blocks (2, n) tell how it grows with each of the keys.
    """

    def __init__(self, origin: Anchor, target: Anchor) -> None:
        by_key: dict[int, Array] = {}
        for sign, end in ((-1.0, origin), (1.0, target)):
            for key, block in ((end.key, end.by_state), (end.parameters, -end.turning)):
                by_key[key] = by_key.get(key, 0.0) + sign * block
        self.keys, self.blocks = list(by_key), list(by_key.values())
        self._by_all = np.hstack(self.blocks)
        self._at_zero_m = target.offset_m - origin.offset_m

    def moved_m(self, values: gtsam.Values) -> Array:
        """Return the way (2,) by an estimate; solvers ask so often that it is one product."""
        states = np.concatenate([values.atVector(key) for key in self.keys])
        return np.asarray(self._by_all @ states + self._at_zero_m)
