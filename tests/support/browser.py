"""Headless Chromium, driven through its DevTools protocol on two pipes: no driver program and no package is needed."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

OPTIONS = (
    "--headless=new", "--remote-debugging-pipe", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
    "--no-first-run", "--disable-extensions", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--hide-scrollbars",
)  # fmt: skip

TIMEOUT_S = 30.0


def chromium() -> str | None:
    """Return the path of a Chromium; None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


@contextmanager
def browser(profile: Path) -> Iterator[Browser]:
    """Give a browser with a profile of its own."""
    program = chromium()
    assert program is not None
    to_browser, from_us = os.pipe()
    to_us, from_browser = os.pipe()
    # The protocol's pipes are descriptors 3 and 4 of the browser.
    command = ["bash", "-c", f'exec "$@" 3<&{to_browser} 4>&{from_browser}', "bash", program, *OPTIONS]
    process = subprocess.Popen(
        [*command, f"--user-data-dir={profile}", "about:blank"], pass_fds=(to_browser, from_browser),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(to_browser)
    os.close(from_browser)
    try:
        yield Browser(from_us, to_us)
    finally:
        process.terminate()
        process.wait(10)
        os.close(from_us)
        os.close(to_us)


class Browser:
    """One browser; `page` opens a tab."""

    def __init__(self, write: int, read: int) -> None:
        self._write, self._read = write, read
        self._number = 0
        self._rest = b""
        self.events: list[dict[str, Any]] = []

    def send(self, method: str, session: str = "", **params: Any) -> dict[str, Any]:
        """Call a method of the protocol, and return its result."""
        self._number += 1
        number, message = self._number, {"id": self._number, "method": method, "params": params}
        os.write(self._write, json.dumps(message | ({"sessionId": session} if session else {})).encode() + b"\0")
        end = time.monotonic() + TIMEOUT_S
        while True:
            for answer in self.receive(end - time.monotonic()):
                if answer.get("id") == number:
                    assert "error" not in answer, answer["error"]
                    return answer["result"]
            assert time.monotonic() < end, f"no answer to {method}"

    def receive(self, timeout_s: float) -> list[dict[str, Any]]:
        """Return the messages that come within a time; events are kept."""
        ready, _, _ = select.select([self._read], [], [], max(timeout_s, 0.0))
        if ready:
            self._rest += os.read(self._read, 1 << 20)
        *whole, self._rest = self._rest.split(b"\0")
        messages = [json.loads(one) for one in whole]
        self.events += [one for one in messages if "method" in one]
        return messages

    def page(self, *, width: int = 1280, height: int = 900, dark: bool = False, scripts: bool = True) -> Page:
        """Open a tab of a size."""
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, session)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.send(f"{domain}.enable")
        page.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        page.send("Emulation.setEmulatedMedia", features=[scheme])
        if not scripts:
            page.send("Emulation.setScriptExecutionDisabled", value=True)
        return page


class Page:
    """One tab."""

    def __init__(self, owner: Browser, session: str) -> None:
        self._owner, self._session = owner, session

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol."""
        return self._owner.send(method, self._session, **params)

    def open(self, file: Path) -> float:
        """Load a file; return how long it took until everything was drawn [s]."""
        self.front()
        begun = time.monotonic()
        self.send("Page.navigate", url=file.absolute().as_uri())
        while not self._events("Page.loadEventFired"):
            assert time.monotonic() - begun < TIMEOUT_S, "the page does not load"
            self._owner.receive(0.5)
        self.send("Page.captureScreenshot", format="jpeg", quality=10)
        return time.monotonic() - begun

    def front(self) -> None:
        """Bring the tab to the front: in the background it answers neither mouse nor keys at once."""
        self.send("Page.bringToFront")

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression; a promise is awaited."""
        found = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send an event of the mouse: ``mouseMoved``, ``mousePressed``, ``mouseReleased``."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        """Click on a place of the window."""
        self.mouse("mouseMoved", x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1, buttons=1)

    def key(self, name: str) -> None:
        """Press a key."""
        codes = {"ArrowRight": 39, "Enter": 13, "Tab": 9, "End": 35, " ": 32}
        text = {"Enter": "\r", " ": " "}.get(name)
        for kind in ("keyDown", "keyUp"):
            more = {"text": text} if text and kind == "keyDown" else {}
            self.send(
                "Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=codes[name], **more
            )

    def screenshot(self, file: Path, *, whole: bool = False) -> Path:
        """Write what is shown, or the whole page, as PNG."""
        found = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        file.write_bytes(base64.b64decode(found["data"]))
        return file

    def complaints(self) -> list[str]:
        """Return errors and warnings of the console, breaches of the security policy among them."""
        self._owner.receive(0.05)
        found = [one["params"]["entry"]["text"] for one in self._events("Log.entryAdded")]
        found += [str(one["params"]["exceptionDetails"]) for one in self._events("Runtime.exceptionThrown")]
        calls = self._events("Runtime.consoleAPICalled")
        return found + [str(one["params"]["args"]) for one in calls if one["params"]["type"] in {"error", "warning"}]

    def requests(self) -> list[str]:
        """Return the addresses that the page asked for, but for data URLs and itself."""
        self._owner.receive(0.05)
        asked = [one["params"]["request"]["url"] for one in self._events("Network.requestWillBeSent")]
        return [url for url in asked[1:] if not url.startswith("data:")]

    def _events(self, method: str) -> list[dict[str, Any]]:
        return [one for one in self._owner.events if one.get("sessionId") == self._session and one["method"] == method]
