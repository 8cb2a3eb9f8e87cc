"""The HTTP API for programs: it reads and changes nothing. ``/api/openapi.json`` describes it."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import Depends, FastAPI, HTTPException, Query, Request
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel

from wearline import __version__
from wearline.errors import BusError
from wearline.messages import AskRecords, Decision, RecordRow, Records, ServiceState, Verdict, WearTrend
from wearline.topics import RECORDS, SERVICES
from wearline_hmi.core import rights
from wearline_hmi.core.maps import ViewHeader, header_json, view_bytes, view_header
from wearline_hmi.pages.frame import Site

DEADLINE_S = 3.0


class ServiceFacts(BaseModel):
    """One service as it was last heard."""

    state: ServiceState | None
    age_s: float | None
    """Since it was heard; None = never. [s]"""
    is_alive: bool | None
    """Its liveliness token; None = never heard of."""


class CellFacts(BaseModel):
    """The cell at this moment."""

    cell: str
    version: str
    last_cycle_id: str | None
    last_decision: Decision | None
    last_verdict_age_s: float | None
    """None = before this server started. [s]"""
    total: int
    passed: int
    failed: int
    not_measured: int
    records_age_s: float | None
    """Since judge told these counts. [s]"""
    services: dict[str, ServiceFacts]


def make_api(site: Site) -> FastAPI:
    """The application that is mounted at ``/api``."""
    service, accounts = site.service, site.keeper.accounts

    async def reader(request: Request) -> str:
        """Who reads: a program with its token, or somebody who is logged in; a viewer does not."""
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            name = accounts.token_name(token.strip())
            if name is not None:
                return name
        else:
            visitor = site.keeper.visitor(request, is_active=False)
            if visitor is not None and visitor.session and visitor.may(rights.LOOK_AT_PRODUCTION):
                return visitor.name
        raise HTTPException(401, "a read-only token is needed", {"WWW-Authenticate": "Bearer"})

    api = FastAPI(
        title="Wearline",
        version=__version__,
        description="Records, wear trend, maps and states of one cell. Reads only; an administrator makes tokens.",
        # The documentation pages of the framework load their script from another machine.
        docs_url=None,
        redoc_url=None,
        openapi_url="/openapi.json",
        dependencies=[Depends(reader)],
        default_response_class=JSONResponse,
    )

    async def records(wanted: AskRecords) -> Records:
        try:
            async with site.asking:
                answer = await asyncio.to_thread(service.ask, RECORDS, wanted, "", DEADLINE_S)
        except BusError as error:
            raise HTTPException(503, str(error)) from error
        if not isinstance(answer, Records):
            raise HTTPException(502, "judge answered with something else")
        return answer

    @api.get("/v1/cell")
    async def cell() -> CellFacts:
        """How the cell is, with the age of everything."""
        state, now_s = service.snapshot, service.clock()

        def age(at_s: float | None) -> float | None:
            return None if at_s is None else round(now_s - at_s, 3)

        return CellFacts(
            cell=service.cell.cell,
            version=__version__,
            last_cycle_id=None if state.verdict is None else state.verdict.cycle_id,
            last_decision=None if state.verdict is None else state.verdict.decision,
            last_verdict_age_s=age(state.verdict_at_s),
            total=state.total,
            passed=state.passed,
            failed=state.failed,
            not_measured=state.not_measured,
            records_age_s=age(state.records_at_s),
            services={
                name: ServiceFacts(
                    state=state.services[name].state,
                    age_s=age(state.services[name].at_s),
                    is_alive=state.services[name].is_alive,
                )
                for name in SERVICES
            },
        )

    @api.get("/v1/records")
    async def list_records(
        last: Annotated[int, Query(ge=1, le=1000)] = 100,
        object_index: Annotated[int | None, Query(ge=0, le=65535)] = None,
        decision: Annotated[list[Decision] | None, Query()] = None,
        search: Annotated[str, Query(max_length=100)] = "",
        before: Annotated[int | None, Query(ge=1)] = None,
    ) -> list[RecordRow]:
        """Records, newest first; `before` the smallest `record_id` of a page is the next one."""
        wanted = AskRecords(
            last=last, object_index=object_index, decisions=tuple(decision or ()), search=search, before=before,
            with_trends=False,
        )  # fmt: skip
        return list((await records(wanted)).rows)

    @api.get("/v1/records/{cycle_id}")
    async def one_record(cycle_id: str) -> Verdict:
        """The whole verdict of one cycle."""
        found = (await records(AskRecords(last=1, cycle_id=cycle_id, with_verdict=True, with_trends=False))).rows
        if not found or not found[0].verdict_json:
            raise HTTPException(404, f"there is no cycle {cycle_id}")
        return Verdict.model_validate_json(found[0].verdict_json)

    @api.get("/v1/trends")
    async def trends(object_index: Annotated[int | None, Query(ge=0, le=65535)] = None) -> list[WearTrend]:
        """Wear against strokes, with its forecast, for one object or all."""
        return list((await records(AskRecords(last=1, object_index=object_index))).trends)

    @api.get("/v1/maps")
    async def maps() -> dict[str, Any]:
        """Names, size and scales of the newest maps."""
        view = service.snapshot.view
        if view is None:
            raise HTTPException(404, "no maps came yet")
        header: ViewHeader = view_header(view)
        return {**header_json(header), "url": f"/api/v1/maps/{view.cycle_id}"}

    @api.get("/v1/maps/{cycle_id}", response_class=Response)
    async def map_values(cycle_id: str) -> Response:
        """The maps as float32, little-endian, [map, row, col]; NaN = not measured. Only the two newest are kept."""
        state = service.snapshot
        view = next((v for v in (state.view, state.view_before) if v is not None and v.cycle_id == cycle_id), None)
        if view is None:
            raise HTTPException(404, "newer strokes have replaced these maps")
        return Response(view_bytes(view), media_type="application/octet-stream")

    return api
