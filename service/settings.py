"""Settings: how this installation runs. The only reader of the environment."""

from __future__ import annotations

import ipaddress
import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, SecretStr, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from spheremark.service.logs import LogFormat
from spheremark.service.tokens import BITS_MIN, Tokens, is_strong

if TYPE_CHECKING:
    from spheremark.storage.catalogue.sandbox import QueryLimits

DATABASE = "spheremark.duckdb"  # in the data folder
_KNOWN_SCHEMES = ("tcp://", "tls://")


def is_loopback(host: str) -> bool:
    """Whether a host is this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class Settings(BaseSettings):
    """How this installation runs; each field can be set as ``SPHEREMARK_<FIELD>``."""

    model_config = SettingsConfigDict(env_prefix="SPHEREMARK_", frozen=True, extra="forbid")

    data: Path = Field(
        default=Path("data"),
        description="Folder that holds the database, the uploaded logs and the clouds.",
    )
    host: str = Field(
        default="127.0.0.1",
        description="Address to listen on; any other than loopback needs a token.",
    )
    port: int = Field(
        default=8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one."
    )
    token: SecretStr | None = Field(
        default=None,
        description="Secret of 128 bits or more that requests carry ('Authorization: Bearer "
        "<token>'), beside those of `spheremark token`.",
    )
    workers: int = Field(
        default_factory=lambda: min(2, os.cpu_count() or 1),
        ge=1,
        le=256,
        description="Worker processes of the cluster that the service starts itself.",
    )
    scheduler: str = Field(
        default="",
        description="Address of an existing Dask cluster (tcp://host:port) to use in its place.",
    )
    job_attempts: int = Field(
        default=3,
        ge=1,
        le=10,
        description="How often a job is started before a dead worker fails it.",
    )
    job_seconds: float = Field(
        default=6 * 3600.0, gt=0, description="Time after which an attempt at a job is ended [s]."
    )
    job_memory_bytes: int = Field(
        default=0,
        ge=0,
        description="Memory of a worker, beyond which it is ended [bytes]; 0: an even share.",
    )
    max_upload_bytes: int = Field(
        default=8 << 30, ge=1, description="Largest log that is accepted [bytes]."
    )
    min_free_bytes: int = Field(
        default=256 << 20,
        ge=0,
        description="Free space of the disk below which no upload is accepted [bytes].",
    )
    quota_bytes: int = Field(
        default=0, ge=0, description="Space that all logs may take [bytes]; 0: no limit."
    )
    sql_seconds: float = Field(
        default=5.0,
        gt=0,
        le=600,
        description="Computing time after which a person's query is ended [s].",
    )
    sql_rows: int = Field(
        default=10_000,
        ge=1,
        le=1_000_000,
        description="Rows after which a result is truncated.",
    )
    sql_memory_bytes: int = Field(
        default=512 << 20, ge=64 << 20, description="Memory that one query may use [bytes]."
    )
    prediction_seconds: float = Field(
        default=300.0,
        gt=0,
        description="Time after which a suggestion of one more mark (POST /api/v1/plans/suggest) "
        "is ended [s]; searches of plans may take as long as a job.",
    )
    prediction_memory_bytes: int = Field(
        default=2 << 30,
        ge=512 << 20,
        description="Memory that such a suggestion, or a search of plans, may use [bytes].",
    )
    log_format: LogFormat = Field(
        default="text", description="Lines of the log: text, or json with ids of request and job."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Least severity that is logged."
    )

    def address(self, port: int | None = None) -> str:
        """Return the address that a browser on this machine opens."""
        known = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "::1": "[::1]"}
        return f"http://{known.get(self.host, self.host)}:{self.port if port is None else port}"

    @property
    def token_text(self) -> str:
        """The token; empty without one."""
        return self.token.get_secret_value() if self.token else ""

    @property
    def database(self) -> Path:
        """File of the database."""
        return self.data / DATABASE

    @property
    def snapshots(self) -> Path:
        """Folder of the copies of the database that queries read."""
        return self.data / "snapshots"

    @property
    def query_limits(self) -> QueryLimits:
        """Limits of one query of people."""
        from spheremark.storage.catalogue.sandbox import QueryLimits

        return QueryLimits(
            seconds=self.sql_seconds, rows=self.sql_rows, memory_bytes=self.sql_memory_bytes
        )

    @model_validator(mode="after")
    def _is_safe(self) -> Self:
        """Refuse an open address without a token, and an address that is no scheduler."""
        if self.token_text and not is_strong(self.token_text):
            raise ValueError(
                f"SPHEREMARK_TOKEN has less than {BITS_MIN} bits; take 22 random characters or "
                "more, or use `spheremark token create NAME`"
            )
        if not is_loopback(self.host) and not Tokens(self.data, self.token_text).all():
            raise ValueError(
                f"host is {self.host}, which others can reach; make a token with `spheremark token "
                "create NAME`, set SPHEREMARK_TOKEN, or listen on 127.0.0.1"
            )
        if self.scheduler and not self.scheduler.startswith(_KNOWN_SCHEMES):
            raise ValueError(
                f"scheduler is {self.scheduler!r}; it must look like tcp://host:port, or be empty"
            )
        return self
