"""Take the pictures of the guide from a running service with surveyed fields.

usage: python -m tests.pictures FOLDER
"""

import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

import uvicorn
from playwright.sync_api import sync_playwright

from spheremark.service.http.app import create_app
from spheremark.service.settings import Settings
from spheremark.storage.catalogue.catalogue import Catalogue
from tests.surveyed import fill

STOP = "/surveys/quarry/stops/lane3-stop1"
PICTURES = {
    "overview": "/",
    "survey": "/surveys/quarry",
    "stop": STOP,
    "report": "/surveys/quarry/report",
    "sql": "/sql?q=SELECT+stop%2C+sigma_3d_m+FROM+latest_station_fixes+ORDER+BY+ALL",
}
SIZE = {"width": 1280, "height": 860}
DRAWN = 2500  # [ms] until the figures of a page are drawn


def main():
    """Write one picture of each page."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.stderr.write("Chromium is not installed: the guide has no pictures.\n")
        return
    with tempfile.TemporaryDirectory() as temporary:
        data = Path(temporary)
        with Catalogue(data / "spheremark.duckdb", snapshots=data / "snapshots") as catalogue:
            fill(catalogue, data / "clouds", "quarry", n_stops=5)
        server = uvicorn.Server(
            uvicorn.Config(create_app(Settings(data=data, workers=1)), port=0, log_level="error")
        )
        thread = threading.Thread(target=server.run)
        thread.start()
        while thread.is_alive() and not server.started:
            time.sleep(0.05)
        address = f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
        try:
            take(chromium, address, folder)
        finally:
            server.should_exit = True
            thread.join(timeout=120)


def take(chromium, address, folder):
    """Open each page and write its picture."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport=SIZE)
        for name, path in PICTURES.items():
            page.goto(address + path)
            page.wait_for_timeout(DRAWN)
            page.screenshot(path=folder / f"{name}.png")
        browser.close()


if __name__ == "__main__":
    main()
