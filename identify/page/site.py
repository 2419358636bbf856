"""Routes of the page, and the headers of every answer."""

import datetime
from collections.abc import Sequence
from importlib.resources import files
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.routing import Route

from armident.identify.documents.diagnosis import VERDICTS
from armident.identify.documents.investigation import OUTCOMES
from armident.identify.monitoring.worker.recorded import stamp_of
from armident.identify.page.attention import CellView, words
from armident.identify.page.cells import file_in
from armident.identify.page.drawings import pictures_of, sparkline
from armident.identify.page.plant import Plant
from armident.identify.report.page import templates_of

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_NOTHING = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
PAGE_POLICY = f"{_NOTHING}style-src 'self'; script-src 'self'; img-src 'self'; connect-src 'self'"
REPORT_POLICY = f"{_NOTHING}sandbox allow-scripts; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
"""Reports contain their scripts and styles; the sandbox gives them an origin of their own, without requests."""
ASSETS = {"page.css": "text/css", "page.js": "text/javascript", "page.svg": "image/svg+xml"}
CURVES = ("residual of", "torque error by joint", "probabilities before and after")
"""Begins of the descriptions of figures with curves before and after, which the page of a cell shows."""

_TEMPLATES = templates_of("armident.identify.page")
_TEMPLATES.globals |= {"verdicts": VERDICTS, "outcomes": OUTCOMES}
_TEMPLATES.filters |= {
    "age": lambda moment: words((datetime.datetime.now(datetime.UTC) - moment).total_seconds()),
    "clock": lambda moment: moment.astimezone().strftime("%Y-%m-%d %H:%M"),
    "moment": lambda seconds: datetime.datetime.fromtimestamp(seconds, datetime.UTC),
    "quoted": lambda text: quote(text, safe=""),
    "sentence": lambda text: text if text.endswith("?") else f"{text.rstrip('.')}.",
    "span": words,
    "sparkline": sparkline,
}


def site(plant: Plant, hosts: Sequence[str]) -> Starlette:
    """Return the application. ``hosts``: those that a request may name (DNS rebinding)."""

    def view_of(request: Request) -> CellView:
        try:
            return plant.view(request.path_params["cell"])
        except KeyError:
            raise HTTPException(404, "There is no such cell.") from None

    def overview(request: Request) -> Response:
        return _page("overview.html", views=plant.views())

    def cell(request: Request) -> Response:
        view, figures = view_of(request), dict[str, list[tuple[int, str]]]()
        for result in (*view.files.documents("diagnosis"), *view.files.documents("investigation")):
            found = enumerate(_pictures(view, result.name))
            figures[result.name] = [(number, alt) for number, (alt, _) in found if alt.startswith(CURVES)]
        return _page("cell.html", view=view, figures=figures)

    def result(request: Request) -> Response:
        path = file_in(view_of(request).cell.folders, request.path_params["result"], request.path_params["file"])
        if path is None:
            raise HTTPException(404, "This result has no such file: it may have been deleted since.")
        return FileResponse(path, headers=HEADERS | {"Content-Security-Policy": REPORT_POLICY})

    def picture(request: Request) -> Response:
        number, found = request.path_params["number"], _pictures(view_of(request), request.path_params["result"])
        if number >= len(found):
            raise HTTPException(404, "This report has no such figure.")
        return _answer(found[number][1], "image/svg+xml", REPORT_POLICY)

    def asset(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            raise HTTPException(404, "There is no such file.")
        return _answer((files("armident.identify.page") / "templates" / name).read_bytes(), ASSETS[name], PAGE_POLICY)

    def failed(request: Request, error: Exception) -> Response:
        known = error if isinstance(error, HTTPException) else HTTPException(500, "Internal error; the log has it.")
        return _page("error.html", known.status_code, code=known.status_code, detail=known.detail)

    routes = [
        Route("/", overview),
        Route("/assets/{name}", asset),
        Route("/cells/{cell}", cell),
        Route("/cells/{cell}/results/{result}/{file}", result),
        Route("/cells/{cell}/results/{result}/figures/{number:int}", picture),
    ]
    guard = Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts), www_redirect=False)
    return Starlette(routes=routes, middleware=[guard], exception_handlers={HTTPException: failed, Exception: failed})


def _pictures(view: CellView, result: str) -> tuple[tuple[str, bytes], ...]:
    """Return the figures of the report of a result."""
    path = file_in(view.cell.folders, result, "report.html")
    return () if path is None else pictures_of(path, stamp_of(path))


def _page(template: str, status: int = 200, **content: object) -> Response:
    text = _TEMPLATES.get_template(template).render(now=datetime.datetime.now().astimezone(), **content)
    return HTMLResponse(text, status, HEADERS | {"Content-Security-Policy": PAGE_POLICY})


def _answer(content: bytes, kind: str, policy: str) -> Response:
    return Response(content, 200, HEADERS | {"Content-Security-Policy": policy}, kind)
