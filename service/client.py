"""A client of a running service, for notebooks: upload logs, wait for jobs, get DataFrames."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Self
from urllib.parse import quote

import httpx

from spheremark.pipelines.errors import InputError, SpheremarkError

if TYPE_CHECKING:
    import pandas as pd

_API = "/api/v1"
_MCAP = "application/vnd.mcap"
_POLL = 0.2  # [s] between two requests for the state of a job
_ACTIVE = ("accepted", "running")
_JOB = ("job_id", "status", "message", "error_reason")  # fields of a job that are read here
_RESULT = ("columns", "rows", "truncated", "row_limit")  # ... and of the result of a query
_SELECT = "SELECT * FROM {view} WHERE survey = {survey}"
_TYPES = {".csv": "text/csv", ".json": "application/json"}


class RemoteError(SpheremarkError):
    """A running service refused or failed to answer."""

    code: ClassVar[str] = "remote"


class Client:
    """A connection to a running service.

    Parameters
    ----------
    url : str
        Address of the service.
    token : str
        Its token, where it has one.
    timeout : float
        Longest wait for one answer [s].
    http : httpx.Client, optional
        Connection to use in place of a new one.

    Examples
    --------
    >>> client = Client("http://127.0.0.1:8000")             # doctest: +SKIP
    >>> client.set_control("quarry", "marks.csv")            # doctest: +SKIP
    >>> client.wait(client.upload("stop1.mcap", survey="quarry"))  # doctest: +SKIP
    >>> client.stations("quarry")                            # doctest: +SKIP
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        token: str = "",
        timeout: float = 60.0,
        http: httpx.Client | None = None,
    ) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self.url = url
        self._http = http or httpx.Client(base_url=url, headers=headers, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def upload(
        self,
        log: str | Path,
        *,
        survey: str,
        name: str = "",
        process: bool = True,
        reading: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Upload a log to a survey, which is made if it is missing, and start its job.

        Parameters
        ----------
        log : str or Path
            The file, or a folder of the files of one log; they are streamed.
        survey : str
            Name of the survey.
        name : str
            Name of the log; that of the file by default.
        process : bool
            Whether to start a job at once.
        reading : mapping, optional
            How to read it, such as ``{"joint": "pan", "joint_unit": "deg"}``.

        Returns
        -------
        dict
            The recording, with its job under ``job``.

        Raises
        ------
        RemoteError
            If the service refuses the log or does not answer.
        InputError
            If there is no such file.
        """
        path = Path(log)
        files = sorted(one for one in path.iterdir() if one.is_file()) if path.is_dir() else [path]
        if not files or not all(one.is_file() for one in files):
            raise InputError(f"There is no log {path}.")
        self._ensure_survey(survey)
        query = {"name": name or path.stem, "survey": survey, "process": str(process).lower()}
        query |= {key: _query_text(value) for key, value in (reading or {}).items()}
        with ExitStack() as stack:
            opened = [(one.name, stack.enter_context(one.open("rb"))) for one in files]
            if path.is_dir():
                parts = [("file", one) for one in opened]
                return self._uploaded(params=query, files=parts)
            return self._uploaded(
                params=query,
                content=opened[0][1],
                headers={"Content-Type": _MCAP},
            )

    def _uploaded(self, **request: Any) -> dict[str, Any]:
        """Send a log; return the recording that it became."""
        return self._fields("POST", "/recordings", ("recording_id", "job"), **request)

    def set_control(self, survey: str, marks: str | Path) -> dict[str, Any]:
        """Give a survey its control marks, from a CSV or JSON file; return them.

        Parameters
        ----------
        survey : str
            Name of the survey, which is made if it is missing.
        marks : str or Path
            File of the known sphere centres.

        Returns
        -------
        dict
            The marks as the service keeps them.

        Raises
        ------
        RemoteError
            If the service refuses them or does not answer.
        """
        path = Path(marks)
        kind = {"Content-Type": _TYPES.get(path.suffix.lower(), "text/csv")}
        url = f"/surveys/{quote(survey, safe='')}/control"
        return self.request("PUT", url, content=path.read_bytes(), headers=kind)

    def start(self, kind: str, survey: str, **options: Any) -> dict[str, Any]:
        """Start a job of a whole survey.

        Parameters
        ----------
        kind : str
            ``adjust``, ``calibrate`` or ``site``.
        survey : str
            Name of the survey.
        **options
            Options of the kind, such as ``control=True`` of ``adjust``.

        Returns
        -------
        dict
            The job.

        Raises
        ------
        RemoteError
            If the service refuses the job or does not answer.
        """
        return self.request(
            "POST", "/jobs", json={"kind": kind, "survey": survey, "options": options}
        )

    def wait(self, job: str | Mapping[str, Any], *, timeout: float = 600.0) -> dict[str, Any]:
        """Wait for the end of a job.

        Parameters
        ----------
        job : str or mapping
            Id of a job, a job, or what ``upload`` returned.
        timeout : float
            Longest wait [s].

        Returns
        -------
        dict
            The job, ended successfully.

        Raises
        ------
        RemoteError
            If it failed, was dismissed, or did not end in time.
        InputError
            If the log was uploaded without a job.
        """
        if not isinstance(job, str):
            found = job.get("job") or job
            if "job_id" not in found:
                raise InputError("There is no job to wait for: the log was uploaded without one.")
            job = str(found["job_id"])
        deadline = time.monotonic() + timeout
        while (state := self._fields("GET", f"/jobs/{job}", _JOB))["status"] in _ACTIVE:
            if time.monotonic() > deadline:
                raise RemoteError(f"Job {job} did not end within {timeout:g} s; it goes on.")
            time.sleep(_POLL)
        if state["status"] != "successful":
            reason = state["error_reason"] or state["message"]
            raise RemoteError(f"Job {job} is {state['status']}: {reason}")
        return state

    def query(self, sql: str, **parameters: Any) -> pd.DataFrame:
        """Return the result of one SELECT.

        Parameters
        ----------
        sql : str
            One SELECT on the tables and views that ``/sql`` describes; ``$name`` stands for a
            parameter.
        **parameters
            Values of its parameters.

        Returns
        -------
        pandas.DataFrame
            Its rows; a warning says so where the service cut them at its limit.

        Raises
        ------
        RemoteError
            If the service refuses the query or does not answer.
        ImportError
            If pandas is not installed.
        """
        import pandas as pd

        body = {"sql": sql, "parameters": parameters}
        answer = self._fields("POST", "/sql", _RESULT, json=body)
        if answer["truncated"]:
            warnings.warn(
                f"The service cut the result at {answer['row_limit']} rows; aggregate or filter, "
                "or export the database.",
                stacklevel=2,
            )
        names = [column["name"] for column in answer["columns"]]
        return pd.DataFrame(answer["rows"], columns=names)

    def markers(self, survey: str) -> pd.DataFrame:
        """Return the newest sphere centres of a survey, one row for each method and marker.

        Parameters
        ----------
        survey : str
            Name of the survey.

        Returns
        -------
        pandas.DataFrame
            Columns as those of the view ``latest_marker_fits``.
        """
        view = "latest_marker_fits"
        return self.query(_SELECT.format(view=view, survey=_text(survey)))

    def stations(self, survey: str) -> pd.DataFrame:
        """Return the newest stations of a survey, one row for each method and stop.

        Parameters
        ----------
        survey : str
            Name of the survey.

        Returns
        -------
        pandas.DataFrame
            Columns as those of the view ``latest_station_fixes``.
        """
        view = "latest_station_fixes"
        return self.query(_SELECT.format(view=view, survey=_text(survey)))

    def _ensure_survey(self, survey: str) -> None:
        """Create a survey that does not exist yet."""
        with reached(self.url):
            found = self._http.get(f"{_API}/surveys/{quote(survey, safe='')}")
            if found.status_code == httpx.codes.NOT_FOUND:
                found = self._http.post(f"{_API}/surveys", json={"name": survey})
        _fields_of(checked(found), ("survey_id",))

    def request(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        """Send a request and return the JSON of its response.

        Parameters
        ----------
        method : str
            Method of HTTP.
        path : str
            Path below ``/api/v1``.
        **request
            Further arguments of ``httpx.Client.request``.

        Returns
        -------
        dict
            The body of the response.

        Raises
        ------
        RemoteError
            If the service refuses the request or does not answer.
        """
        return self._fields(method, path, (), **request)

    def _fields(
        self, method: str, path: str, names: tuple[str, ...], **request: Any
    ) -> dict[str, Any]:
        """Send a request and return the JSON of its response, which has fields of these names."""
        with reached(self.url):
            response = self._http.request(method, f"{_API}{path}", **request)
        return _fields_of(checked(response), names)

    def download(self, path: str, target: Path, **query: str) -> None:
        """Stream a file of the service to a file on disk.

        Parameters
        ----------
        path : str
            Path below ``/api/v1``.
        target : Path
            File to write.
        **query
            Parameters of the request.

        Raises
        ------
        RemoteError
            If the service refuses the request, does not answer, or something else answers. A file
            that was there before is kept then.
        """
        part = target.with_name(f"{target.name}.part")
        with (
            reached(self.url),
            self._http.stream("GET", f"{_API}{path}", params=query) as response,
        ):
            if response.is_error:
                response.read()
            if "content-disposition" not in checked(response).headers:  # each of ours names a file
                raise _stranger(response)
            try:
                with part.open("wb") as file:
                    file.writelines(response.iter_bytes())
                part.replace(target)
            finally:
                part.unlink(missing_ok=True)


@contextmanager
def reached(url: str) -> Iterator[None]:
    """Turn a failed connection into a sentence."""
    try:
        yield
    except httpx.HTTPError as error:
        raise RemoteError(
            f"No service answers at {url} ({error}); start `spheremark serve` there, or "
            "name another address."
        ) from error


def checked(response: httpx.Response) -> httpx.Response:
    """Return a response; raise one that is a problem."""
    if response.is_error:
        raise RemoteError(str(_fields_of(response, ("detail",))["detail"]))
    return response


def _fields_of(response: httpx.Response, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the JSON of a response; raise RemoteError where something else has answered."""
    try:
        found = response.json()
    except ValueError:
        found = None
    if not isinstance(found, dict) or not found.keys() >= set(names):
        raise _stranger(response)
    return found


def _stranger(response: httpx.Response) -> RemoteError:
    """Return the error that something else has answered."""
    return RemoteError(
        f"{response.url} answers {response.status_code} {response.reason_phrase}, but not as "
        "a spheremark service does. Check the address, and the proxy before it if there is one."
    )


def _query_text(value: Any) -> Any:
    """Return a value as a query has it."""
    return str(value).lower() if isinstance(value, bool) else value


def _text(value: str) -> str:
    """Return a text as an SQL literal."""
    return "'" + value.replace("'", "''") + "'"
