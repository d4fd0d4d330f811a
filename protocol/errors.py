"""The errors that Fathomlink raises, each with the one who has to act."""


class FathomError(Exception):
    """Base of every error raised on purpose; the message says what would be right."""


class ProtocolError(FathomError):
    """A packet or a frame breaks the rules of WIRE.md."""


class LocalProtocolError(ProtocolError):
    """We were asked to send what the wire cannot carry: a bug on this side."""


class RemoteProtocolError(ProtocolError):
    """The peer, or the sea, sent what cannot be accepted: counted and dropped.

    `cause` is one word for the counter that the drop belongs to: size, crc, version, profile,
    layout, or one of the causes in `protocol.seal`.
    """

    def __init__(self, message: str, *, cause: str = "layout") -> None:
        super().__init__(message)
        self.cause = cause


class ModemError(FathomError):
    """A modem did not do what it was asked."""


class ModemTimeout(ModemError, TimeoutError):  # noqa: N818  the name says what happened
    """A modem did not answer in time."""


class ModemUnavailable(ModemError):  # noqa: N818  the name says what happened
    """The port is not there, or has vanished."""


class ConfigError(FathomError):
    """A setting, a scenario or an input file is wrong."""


class EstimationError(FathomError):
    """An estimate cannot be formed from what is known."""
