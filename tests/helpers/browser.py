"""A headless Chromium driven over its DevTools protocol: pages are opened from disk, as a reader does."""

import itertools
import json
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
ERRORS = ("Runtime.exceptionThrown", "Log.entryAdded")


class Browser:
    """One tab; `errors` collects what a page throws or logs as an error."""

    def __init__(self, folder: Path) -> None:
        program = next((path for name in NAMES if (path := shutil.which(name))), None)
        if program is None:
            pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
        client = pytest.importorskip("websockets.sync.client", reason="websockets talks to the browser")
        options = ("--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0")
        self._process = subprocess.Popen(
            [program, *options, f"--user-data-dir={folder}", "about:blank"], stderr=subprocess.PIPE, text=True
        )
        address = next((found[0] for line in self._process.stderr if (found := re.search(r"ws://\S+", line))), None)
        if address is None:
            pytest.skip(f"{program} does not start")
        self._socket = client.connect(address, max_size=None)
        self._numbers = itertools.count(1)
        self._session: dict[str, str] = {}
        self.errors: list[Any] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params) -> dict[str, Any]:
        """Send a command and return its result; errors of the page on the way are collected."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params, **self._session}))
        while (answer := json.loads(self._socket.recv(timeout=60))).get("id") != number:
            if answer.get("method") in ERRORS:
                self.errors.append(answer["params"])
        assert "error" not in answer, answer
        return answer["result"]

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression on the page."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def open(
        self, path: Path, *, width: int = 1280, height: int = 800, dark: bool = False, script: bool = True
    ) -> None:
        """Open a file of the disk in a window of some size."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.errors.clear()
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Emulation.setScriptExecutionDisabled", value=not script)
        self.call("Page.navigate", url=path.as_uri())
        while self.run("location.protocol + document.readyState") != "file:complete":
            time.sleep(0.01)

    def close(self) -> None:
        """End the browser."""
        self._socket.close()
        self._process.kill()
        self._process.communicate()
