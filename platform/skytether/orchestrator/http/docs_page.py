"""``/docs``: the API's description for people, from what is installed here. It asks no other host for anything."""

from __future__ import annotations

from importlib.resources import files

from fastapi import APIRouter, Response

_ASSETS = "fastapi_offline"
"""The package that ships Swagger UI's own files; nothing else of it is used."""
_KINDS = {"swagger-ui-bundle.js": "text/javascript", "swagger-ui.css": "text/css"}
_HEADERS = {
    # Swagger UI draws with styles of elements, and has its icons as data.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_PAGE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>Skytether's API</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="docs/swagger-ui.css">
</head>
<body>
<div id="page">This page needs JavaScript; the same as JSON: <a href="openapi.json">openapi.json</a>.</div>
<script src="docs/swagger-ui-bundle.js"></script>
<script src="docs/start.js"></script>
</body>
</html>
"""
_START = """\
SwaggerUIBundle({
  url: "openapi.json", dom_id: "#page", validatorUrl: null, deepLinking: true,
  presets: [SwaggerUIBundle.presets.apis],
});
"""

router = APIRouter(include_in_schema=False)


@router.get("/docs")
def page() -> Response:
    """The page."""
    return Response(_PAGE, media_type="text/html", headers=_HEADERS)


@router.get("/docs/start.js")
def start() -> Response:
    """What begins it; within the page it would be a script that any other could be put beside."""
    return Response(_START, media_type="text/javascript", headers=_HEADERS)


def _asset(name: str, kind: str) -> None:
    @router.get(f"/docs/{name}")
    def asset() -> Response:
        content = files(_ASSETS).joinpath("static", name).read_bytes()
        return Response(content, media_type=kind, headers={**_HEADERS, "Cache-Control": "max-age=86400"})


for _name, _kind in _KINDS.items():
    _asset(_name, _kind)
