"""Pages that the tests of this folder open in a real Chromium, and how they are watched."""

import re
import shutil
import threading
import time
from contextlib import contextmanager

import pytest
import uvicorn

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NEEDS_CHROMIUM = pytest.mark.skipif(
    CHROMIUM is None, reason="Chromium is not installed; on Debian: apt-get install chromium"
)

STOP = "/surveys/field/stops/lane3-stop1"
PAGES = [
    "/",
    "/surveys/field",
    "/surveys/field/accuracy?axes=log&method=along_beam",
    "/accuracy",
    "/compare",
    "/surveys/field/cloud",
    "/surveys/field/stops",
    "/surveys/field/network",
    "/surveys/field/rig",
    "/surveys/field/site",
    "/surveys/field/logs",
    "/new",
    "/surveys/blind",
    STOP,
    f"{STOP}?method=paper&marker=M03",
    "/live",
    "/jobs",
    "/docs",
    "/glossary",
    "/surveys/field/report",
    "/plan?a=P01:6.5,0.5,1;P02:-1,6.5,1;P03:-6.5,-3,1&b=P01:6.5,0.5,1;P02:-1,6.5,1&stop=lane3-stop1",
    "/plan/random?n_arrangements=2000",
    "/sql?q=SELECT+stop%2C+x_m%2C+y_m+FROM+latest_station_fixes+ORDER+BY+ALL",
]
HARMLESS = re.compile("GPU stall|willReadFrequently|GroupMarkerNotSet")  # no GPU in a test


@contextmanager
def served(data, scheduler):
    """Serve a data folder, and give the address."""
    app = create_app(Settings(data=data, scheduler=scheduler))
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        assert thread.is_alive(), "The service did not start."
        time.sleep(0.05)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(timeout=120)


class Visit:
    """A page that is watched while it loads, in a tab that has shown others of its address.

    What a page keeps, such as a theme, ends with the visit; compiled scripts stay, which halves the
    time of a test.
    """

    def __init__(self, page, address, *, width=1440, scheme="light"):
        self.page, self.address, self.complaints, self.strangers = page, address, [], []
        self.page.set_viewport_size({"width": width, "height": 900})
        self.page.emulate_media(color_scheme=scheme)
        self.listeners = {
            "console": self._hear,
            "pageerror": self._fail,
            "request": self._see,
        }
        for event, listener in self.listeners.items():
            self.page.on(event, listener)

    def _hear(self, message):
        if message.type in ("error", "warning") and not HARMLESS.search(message.text):
            self.complaints.append(message.text)

    def _fail(self, error):
        self.complaints.append(str(error))

    def _see(self, request):
        if not request.url.startswith((self.address, "data:", "blob:")):
            self.strangers.append(request.url)

    def open(self, path):
        self.page.goto(self.address + path)
        searching = "[data-search], [data-search-request]"  # it loads the page again at its end
        self.page.wait_for_selector(searching, state="detached", timeout=120_000)
        self.page.wait_for_selector("[data-figure]:not([data-drawn])", state="detached")
        return self.page

    def end(self):
        """Leave the page, and forget what it has kept."""
        for event, listener in self.listeners.items():
            self.page.remove_listener(event, listener)
        self.page.unroute_all(behavior="ignoreErrors")
        if self.page.url.startswith(self.address):
            self.page.evaluate("sessionStorage.clear()")
        self.page.goto("about:blank")
        self.page.mouse.move(0, 0)
        kept = {"origin": self.address, "storageTypes": "cookies,local_storage,indexeddb"}
        self.page.context.new_cdp_session(self.page).send("Storage.clearDataForOrigin", kept)
