"""The one error tree: each class has a sentence for people and a stable code for programs."""

from typing import ClassVar


class SpheremarkError(Exception):
    """Something went wrong in spheremark."""

    code: ClassVar[str] = "error"


class InputError(SpheremarkError):
    """The input cannot be used as it is."""

    code: ClassVar[str] = "input"


class ConfigError(InputError):
    """A configuration value is unknown or out of range."""

    code: ClassVar[str] = "input.config"


class RecordingError(InputError):
    """The recording is unreadable, incomplete, or its clocks do not overlap."""

    code: ClassVar[str] = "input.recording"


class NotMcapError(RecordingError):
    """The file is not an MCAP file."""

    code: ClassVar[str] = "input.recording.not_mcap"


class TruncatedRecordingError(RecordingError):
    """The recording ends before it is complete."""

    code: ClassVar[str] = "input.recording.truncated"


class MissingLidarError(RecordingError):
    """The recording holds no LiDAR topic."""

    code: ClassVar[str] = "input.recording.no_lidar"


class MissingGimbalAngleError(RecordingError):
    """The recording lacks the angle of the gimbal."""

    code: ClassVar[str] = "input.recording.no_gimbal_angle"


class MissingPulseTimesError(RecordingError):
    """The gimbal turns continuously, but the points carry no time of their own."""

    code: ClassVar[str] = "input.recording.no_shot_times"


class MissingRigError(RecordingError):
    """The mounting of the LiDAR on the gimbal is not described."""

    code: ClassVar[str] = "input.recording.no_rig"


class RigError(InputError):
    """The description of the rig cannot be used."""

    code: ClassVar[str] = "input.rig"


class ControlError(InputError):
    """The table of control marks cannot be used."""

    code: ClassVar[str] = "input.control"


class TruthError(InputError):
    """The truth file cannot be used."""

    code: ClassVar[str] = "input.truth"


class SolveError(SpheremarkError):
    """No answer exists for these observations."""

    code: ClassVar[str] = "solve"


class TooFewObservationsError(SolveError):
    """There are fewer observations than unknowns."""

    code: ClassVar[str] = "solve.too_few"


class NoMarkersError(TooFewObservationsError):
    """No spherical marker was found in the scan."""

    code: ClassVar[str] = "solve.no_markers"


class NoGroundError(TooFewObservationsError):
    """No ground was seen."""

    code: ClassVar[str] = "solve.no_ground"


class DegenerateGeometryError(SolveError):
    """The geometry leaves an unknown undetermined."""

    code: ClassVar[str] = "solve.degenerate"


class AmbiguousMatchError(SolveError):
    """The markers fit the control marks in more than one way."""

    code: ClassVar[str] = "solve.ambiguous"


class NoMatchError(SolveError):
    """The markers do not fit the control marks in any way."""

    code: ClassVar[str] = "solve.no_match"


class NotConvergedError(SolveError):
    """The adjustment did not converge."""

    code: ClassVar[str] = "solve.not_converged"


class NotFoundError(SpheremarkError):
    """There is no such thing."""

    code: ClassVar[str] = "not_found"


class ConflictError(SpheremarkError):
    """The request contradicts what is already there."""

    code: ClassVar[str] = "conflict"
