"""cell.yaml: one file describes a cell; each service reads its own section of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from wearline.errors import ConfigError


class Settings(BaseModel):
    """Base of all settings: frozen, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class TlsSettings(Settings):
    """Certificates (PEM): each participant proves who it is, and the router lets it say only what is its own."""

    authority: Path
    """Certificate of the authority that signed all others; relative to cell.yaml."""
    folder: Path
    """Holds <name>.pem and <name>-key.pem, issued to <name>.<cell>, of the services that run here and of the router;
    relative to cell.yaml."""

    def files_of(self, participant: str) -> tuple[Path, Path]:
        """Certificate and private key of a service or of the router."""
        return self.folder / f"{participant}.pem", self.folder / f"{participant}-key.pem"


class RouterSettings(Settings):
    """Where the cell's router listens."""

    endpoint: str = Field(default="tcp/127.0.0.1:7447", pattern=r"^(tcp|tls)/.+:\d+$")
    listen: str | None = Field(default=None, pattern=r"^(tcp|tls)/.+:\d+$")
    """Where the router binds when it differs from where services connect (containers)."""
    tls: TlsSettings | None = None
    """Without it everybody who reaches the router is believed: for one machine or a network of the cell's own."""

    @model_validator(mode="after")
    def _encrypted_or_not(self) -> Self:
        for address in filter(None, (self.endpoint, self.listen)):
            if address.startswith("tls/") is (self.tls is None):
                raise ValueError(f"{address} and the setting 'tls' go together: both, or neither")
        return self


class CellSettings(Settings):
    """cell.yaml."""

    cell: str = Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")
    """Name of the cell: part of every key and metric."""
    data_dir: Path
    """Where everything durable lives, a folder per service; relative to cell.yaml."""
    plc_is_simulated: bool = False
    """Only then may a simulated verdict reach the PLC as Passed."""
    router: RouterSettings = RouterSettings()
    metrics_host: str = "127.0.0.1"
    metrics_ports: dict[str, int] = Field(default_factory=dict)
    """Port of /metrics and /healthz per service (0 = any free one)."""
    capture: dict[str, Any] = Field(default_factory=dict)
    reconstruct: dict[str, Any] = Field(default_factory=dict)
    judge: dict[str, Any] = Field(default_factory=dict)
    fieldbus: dict[str, Any] = Field(default_factory=dict)
    hmi: dict[str, Any] = Field(default_factory=dict)
    plc_sim: dict[str, Any] = Field(default_factory=dict)

    def data_folder(self, service: str) -> Path:
        """Folder of one service, made if absent."""
        folder = self.data_dir / service
        folder.mkdir(parents=True, exist_ok=True)
        return folder


S = TypeVar("S", bound=Settings)


def validated(kind: type[S], content: dict[str, Any], where: str) -> S:
    """Check one mapping against its settings.

    Raises:
        ConfigError: with the place of the first fault.
    """
    try:
        return kind(**content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{place}: {first['msg']}", where, "see 'wearline run SERVICE --schema'") from error


def load_cell(path: Path) -> CellSettings:
    """Read cell.yaml; relative paths count from the file's own folder.

    Raises:
        ConfigError: unreadable, not YAML, or not valid.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read ({error})", str(path), "name an existing cell.yaml") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"not YAML ({' '.join(str(error).split())})", str(path), "mend the syntax") from error
    if not isinstance(content, dict):
        raise ConfigError("is not a mapping of settings", str(path), "start from deploy/cells/")
    cell = validated(CellSettings, {str(k): v for k, v in content.items()}, str(path))
    changes: dict[str, Any] = {"data_dir": (path.parent / cell.data_dir).resolve()}
    if (tls := cell.router.tls) is not None:
        found = TlsSettings(
            authority=(path.parent / tls.authority).resolve(), folder=(path.parent / tls.folder).resolve()
        )
        changes["router"] = cell.router.model_copy(update={"tls": found})
    return cell.model_copy(update=changes)


def schema(kind: type[Settings]) -> str:
    """JSON schema of some settings."""
    return json.dumps(kind.model_json_schema(), indent=2, sort_keys=True)
