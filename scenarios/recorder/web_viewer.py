"""Recordings in a browser: the viewer's own page and the files, from one port of the loopback.

Rerun's servers are not used for this. `rerun.serve_web_viewer` listens on every address of the machine, the program's
`--web-viewer FILE` keeps a core busy for as long as it runs, and both pages ask Google for a font, GitHub for a newer
version and report usage to Rerun. So the page is taken from the installed viewer once, at the start, and served here
together with the recordings, as plain files; whatever it wants from elsewhere it does not get.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Final, Self

from scenarios.recorder.viewer import HOST, free_port, started, wait_until_listening
from sitl.errors import UsageError

PORT: Final = 9090
"""Where Rerun's own page is, too."""

PAGE: Final = {
    "/": "text/html; charset=utf-8",
    "/re_viewer.js": "text/javascript",
    "/re_viewer_bg.wasm": "application/wasm",
    "/sw.js": "text/javascript",
    "/favicon.ico": "image/x-icon",
    "/apple-touch-icon.png": "image/png",
}
"""Files of the viewer's page -> their type."""

RECORDINGS: Final = "/recordings/"

_POLICY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' data: blob:; worker-src 'self' blob:; frame-ancestors 'none'"
)
_OUTSIDE: Final = re.compile(rb"<link\b[^>]*\bhref=\"https?://[^>]*>", re.DOTALL)
_ALONE: Final = b"""<script>
const anywhere = window.fetch;
window.fetch = (what, how) => {
  const url = new URL(what instanceof Request ? what.url : what, location.href);
  const here = url.origin === location.origin || ["data:", "blob:"].includes(url.protocol);
  return here ? anywhere(what, how) : Promise.resolve(new Response(null, {status: 204}));
};
</script>
"""
"""The policy above would refuse the requests to elsewhere, too, with a red line in the console for each."""

_FETCH_S: Final = 60.0


def viewer_page() -> dict[str, bytes]:
    """The files of the installed viewer's page, path -> bytes, without what it would load from elsewhere.

    Raises:
        UsageError: the viewer is not installed, does not start, or has no such page.
    """
    web, grpc = free_port(), free_port()
    files = {}
    with started("--serve-web", "--web-viewer-port", str(web), "--port", str(grpc)) as process:
        wait_until_listening(process, web)
        for path in PAGE:
            try:
                with urllib.request.urlopen(f"http://{HOST}:{web}{path}", timeout=_FETCH_S) as answer:
                    files[path] = answer.read()
            except (OSError, urllib.error.URLError) as error:
                raise UsageError(f"the installed viewer has no page for browsers ({path}: {error})") from error
    files["/"] = _OUTSIDE.sub(b"", files["/"]).replace(b"<head>", b"<head>" + _ALONE, 1)
    return files


class WebViewer:
    """Serves recordings and the viewer's page; use it as a context manager.

    Args:
        recordings: .rrd files, the one to be shown first at the front.
        port: of 127.0.0.1; 0 for any that is free.

    Attributes:
        page: path -> bytes, of `viewer_page`; set it before `serve`.

    Raises:
        UsageError: the port is taken.
    """

    def __init__(self, recordings: Sequence[Path], port: int = PORT) -> None:
        self._files = {f"{RECORDINGS}{number}/{path.name}": path for number, path in enumerate(recordings)}
        try:
            self._server = _Server((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise UsageError(
                f"port {port} of {HOST} cannot be used: {getattr(error, 'strerror', None) or error}. Give another one "
                "with --port, or 0 for any that is free"
            ) from error
        self._server.files = self._files

    @property
    def page(self) -> Mapping[str, bytes]:
        """Files of the page; none until they are set."""
        return self._server.page

    @page.setter
    def page(self, page: Mapping[str, bytes]) -> None:
        self._server.page = page

    @property
    def port(self) -> int:
        """Where it listens, on 127.0.0.1."""
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """What to open in a browser."""
        here = f"http://{HOST}:{self.port}"
        query = [("url", here + urllib.parse.quote(path)) for path in self._files]
        return f"{here}/?{urllib.parse.urlencode([*query, ('hide_welcome_screen', '1')])}"

    def serve(self) -> None:
        """Answer until `stop` is called elsewhere, or Ctrl-C comes."""
        self._server.serve_forever(poll_interval=0.2)

    def stop(self) -> None:
        """End `serve`; from another thread."""
        self._server.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    page: Mapping[str, bytes] = MappingProxyType({})
    files: Mapping[str, Path]


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    server_version = "froude"
    sys_version = ""
    timeout = 30.0

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 the base class's name
        """Nobody asked for a line per file."""

    def _answer(self, *, with_body: bool) -> None:
        # a page from elsewhere whose name leads to 127.0.0.1 must not read recordings
        own = {f"{name}:{self.server.server_address[1]}" for name in (HOST, "localhost")}
        if self.headers.get("Host", "") not in own:
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        path = urllib.parse.unquote(urllib.parse.urlsplit(self.path).path)
        with contextlib.suppress(ConnectionError, TimeoutError):
            if path in self.server.page:
                self._head(PAGE[path], len(self.server.page[path]))
                if with_body:
                    self.wfile.write(self.server.page[path])
            elif path in self.server.files:
                self._send_file(self.server.files[path], with_body=with_body)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

    def _send_file(self, path: Path, *, with_body: bool) -> None:
        try:
            file = path.open("rb")
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with file:
            self._head("application/octet-stream", path.stat().st_size)
            if with_body:
                shutil.copyfileobj(file, self.wfile)

    def _head(self, kind: str, size: int) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(size))
        self.send_header("Rerun-Final-Length", str(size))  # the page draws its progress by it
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-cache")
        self.end_headers()
