"""Routes that explain problems, and the configuration that a job may have."""

from __future__ import annotations

from fastapi import APIRouter

from spheremark.pipelines.config import SurveyConfig
from spheremark.pipelines.errors import NotFoundError
from spheremark.service import errors
from spheremark.service.http.api.models import Listing, ProblemKind

router = APIRouter(tags=["about"])


@router.get("/problems", name="list_problems")
def list_problems() -> Listing[ProblemKind]:
    """List the kinds of problems that a response may name."""
    return Listing(items=_kinds())


@router.get("/problems/{code}", name="get_problem")
def get_problem(code: str) -> ProblemKind:
    """Explain a kind of problem."""
    for kind in _kinds():
        if kind.code == code:
            return kind
    raise NotFoundError(f"There is no problem called {code!r}; /api/v1/problems lists them.")


@router.get("/config", name="get_config")
def get_config() -> SurveyConfig:
    """Return the default configuration of a job: every scientific parameter."""
    return SurveyConfig()


def _kinds() -> list[ProblemKind]:
    """Return every kind of problem, those of the framework too."""
    own = {
        kind.code: ProblemKind(
            code=kind.code, title=errors.sentence_of(kind), status=errors.status_of(kind)
        )
        for kind in errors.kinds()
    }
    for code, (title, status) in errors.OTHER_KINDS.items():
        own[code] = ProblemKind(code=code, title=title, status=status)
    return [own[code] for code in sorted(own)]
