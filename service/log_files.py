"""Log files through the pipeline: what commands, jobs and benchmarks share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from spheremark.pipelines.calibration import Calibration, calibrate
from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import (
    NoMarkersError,
    RigError,
    SolveError,
    SpheremarkError,
)
from spheremark.pipelines.model import (
    ControlMarks,
    MarkerFits,
    Origin,
    Rig,
    ScanLog,
    StopResult,
    Truth,
)
from spheremark.pipelines.network import AdjustedNetwork, Refusal, adjust_network, assemble
from spheremark.pipelines.progress import Progress, part_of
from spheremark.pipelines.survey import StopErrors, process, stop_errors
from spheremark.storage.recordings import LogFile, LogOptions, diagnosis

_SCANS = 0.95  # share of the time of an adjustment that the scans take


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessedLog:
    """A log with the results of its stops; ``errors`` are against truth, by stop, where known."""

    origin: Origin
    notes: tuple[str, ...]
    config: SurveyConfig
    marks: ControlMarks | None
    stops: tuple[StopResult, ...]
    errors: Mapping[str, StopErrors]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fieldbook:
    """The centres of each station of a survey, and the stations without centres.

    ``calibration`` is the rig from the same logs, if requested; ``uncalibrated`` is the reason why
    they do not determine it.
    """

    scans: tuple[tuple[str, MarkerFits], ...]
    refused: tuple[Refusal, ...]
    calibration: Calibration | None = None
    uncalibrated: str = ""


def process_file(
    file: LogFile,
    config: SurveyConfig,
    progress: Progress,
    *,
    rig: Rig | None = None,
    marks: ControlMarks | None = None,
    truth: Truth | None = None,
) -> ProcessedLog:
    """Process a log; the truth, if given, adds errors and changes nothing else."""
    progress(0.0, f"Reading {file.path.name}")
    logs = [_read(file)]
    origin, notes = logs[0].origin, logs[0].notes
    with naming(file):
        try:
            stops = process(  # releases the log once it is stitched: no reference may remain here
                logs.pop(), config=config, rig=rig, marks=marks, progress=progress
            )
        except NoMarkersError as error:
            raise explained(
                error, lambda one: replace(file, options=one).read(), file.options, rig
            ) from error
    errors = {stop.name: stop_errors(stop, truth) for stop in stops} if truth else {}
    return ProcessedLog(
        origin=origin,
        notes=tuple(notes),
        config=config,
        marks=marks,
        stops=stops,
        errors={name: one for name, one in errors.items() if one is not None},
    )


def explained(
    error: NoMarkersError,
    read: Callable[[LogOptions], ScanLog],
    options: LogOptions,
    rig: Rig | None,
) -> NoMarkersError:
    """Return the error of a log without spheres with what other ways to read it show."""
    found = diagnosis(read(options), options, read, rig)
    return NoMarkersError(" ".join((str(error), *found)))


def read_scans(
    files: Sequence[LogFile], config: SurveyConfig, rig: Rig | None, progress: Progress
) -> Fieldbook:
    """Find the markers of each log; a log that fails is refused, and the error raised if all do."""
    scans: list[tuple[str, MarkerFits]] = []
    refused: list[Refusal] = []
    first: SpheremarkError | None = None
    for i, file in enumerate(files):
        try:
            part = part_of(progress, _SCANS * i / len(files), _SCANS * (i + 1) / len(files))
            with naming(file):
                stops = process(file.read(), config=config, rig=rig, progress=part)
            scans += [(stop.name, stop.fits[config.fitting.methods[0]]) for stop in stops]
        except SpheremarkError as error:
            first = first or error
            refused.append(Refusal(station=file.path.stem, code=error.code, reason=str(error)))
    if not scans and first is not None:
        raise first
    return Fieldbook(scans=tuple(scans), refused=tuple(refused))


def with_calibration(
    book: Fieldbook,
    files: Sequence[LogFile],
    config: SurveyConfig,
    rig: Rig | None,
    progress: Progress,
) -> Fieldbook:
    """Return a fieldbook with the rig from its logs, or the reason why they do not determine it."""
    refused = {one.station for one in book.refused}
    good = [file for file in files if file.path.stem not in refused]
    try:
        return replace(book, calibration=calibrate_files(good, config, rig, progress))
    except (SolveError, RigError) as error:
        return replace(book, uncalibrated=str(error))


def adjust_scans(
    book: Fieldbook, control: ControlMarks | None, config: SurveyConfig
) -> AdjustedNetwork:
    """Adjust all stations and marks together, and the rig where the fieldbook has one."""
    network = assemble(book.scans, control, config.resection, book.calibration)
    network = replace(network, refused=(*book.refused, *network.refused))
    return adjust_network(network, config.resection)


def adjusted_rig(result: AdjustedNetwork, book: Fieldbook) -> Calibration | None:
    """Return the calibration of a fieldbook as corrected by the network, if there is one."""
    if book.calibration is None:
        return None
    k = len(book.calibration.unknowns)
    return book.calibration.corrected(result.shared[:k], result.cov_shared[:k, :k])


def merged_truth(truths: Sequence[Truth]) -> Truth:
    """Return the truth of a survey from those of its logs, which share their marks."""
    stops = {stop.name: stop for truth in truths for stop in truth.stops}
    return replace(truths[0], stops=tuple(stops.values()))


@dataclass(frozen=True, slots=True)
class _Logs:
    """Logs that are read one by one in each pass of a calibration; a single one is kept."""

    files: tuple[LogFile, ...]
    kept: tuple[ScanLog, ...]

    def __iter__(self) -> Iterator[ScanLog]:
        return iter(self.kept) if self.kept else (_read(file) for file in self.files)


def calibrate_files(
    files: Sequence[LogFile], config: SurveyConfig, rig: Rig | None, progress: Progress
) -> Calibration:
    """Estimate the rig from the spheres of some logs."""
    kept = (_read(files[0]),) if len(files) == 1 else ()
    return calibrate(_Logs(tuple(files), kept), config=config, rig=rig, progress=progress)


def _read(file: LogFile) -> ScanLog:
    """Read one log of several; an error names it."""
    with naming(file):
        return file.read()


@contextmanager
def naming(file: LogFile) -> Iterator[None]:
    """Put the name of a log in front of the text of errors."""
    try:
        yield
    except SpheremarkError as error:
        if file.path.name not in str(error):
            error.args = (f"{file.path.name}: {error}", *error.args[1:])
        raise
