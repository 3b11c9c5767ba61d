"""A headless Chromium, driven over the DevTools protocol through a pipe. No package is needed."""

import contextlib
import fcntl
import itertools
import json
import os
import pathlib
import shutil
import signal
import time
from collections.abc import Iterator
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
MISSING = "no Chromium found: install the package chromium to test pages in a browser"
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"),
    *("--remote-debugging-pipe", "--disable-dev-shm-usage", "--host-resolver-rules=MAP * ~NOTFOUND"),
)


class Tab:
    """One page of the browser; `errors`: what its console reported as an error, and uncaught exceptions."""

    def __init__(self, send: int, receive: int) -> None:
        self.send, self.receive, self.buffer = send, receive, b""
        self.numbers, self.errors, self.session = itertools.count(1), [], None
        self.requests: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: object) -> Any:
        """Call a method of the protocol and return its result."""
        number = next(self.numbers)
        message = {"id": number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.send, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._message()
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self._note(answer)

    def _message(self) -> Any:
        while b"\0" not in self.buffer:
            more = os.read(self.receive, 1 << 20)
            if not more:
                raise RuntimeError("the browser ended")
            self.buffer += more
        one, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(one)

    def _note(self, event: Any) -> None:
        method, params = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"].get("exception", {}).get("description", str(params)))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.errors.append(" ".join(str(x.get("value", x.get("description"))) for x in params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"][:200])

    def size(self, width: int, height: int = 900) -> None:
        """Set the size of the window in pixels."""
        pixels = {"width": width, "height": height, "deviceScaleFactor": 1}
        self.call("Emulation.setDeviceMetricsOverride", **pixels, mobile=width < 500)

    def open(self, path: pathlib.Path) -> None:
        """Open a file."""
        self.call("Page.navigate", url=path.resolve().as_uri())

    def run(self, script: str) -> Any:
        """Evaluate JavaScript, wait for a promise, and return the value."""
        done = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in done:
            raise RuntimeError(str(done["exceptionDetails"].get("exception", {}).get("description")))
        return done["result"].get("value")

    def wait(self, condition: str, seconds: float = 30.0) -> None:
        """Wait until a JavaScript condition holds."""
        until = time.monotonic() + seconds
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > until:
                raise TimeoutError(f"{condition}; console: {self.errors}")
            time.sleep(0.02)

    def key(self, name: str) -> None:
        """Press a key of KEYS."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=KEYS[name])

    def click(self, selector: str) -> None:
        """Click the middle of an element."""
        self.run(f"document.querySelector({selector!r}).scrollIntoView({{block:'center'}})")
        middle = "(r => [r.x + r.width / 2, r.y + r.height / 2])"
        x, y = self.run(f"{middle}(document.querySelector({selector!r}).getBoundingClientRect())")
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)


KEYS = {"ArrowRight": 39, "End": 35}


@contextlib.contextmanager
def browser(folder: pathlib.Path) -> Iterator[Tab]:
    """Start Chromium with its profile in `folder`, and yield a tab. No name of a host resolves."""
    assert CHROMIUM, MISSING
    pipes = [*os.pipe(), *os.pipe()]
    to_read, send, receive, to_write = (fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in pipes)
    # not subprocess with preexec_fn: JAX warns of a fork
    actions = [(os.POSIX_SPAWN_DUP2, to_read, 3), (os.POSIX_SPAWN_DUP2, to_write, 4)]
    actions.append((os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0))
    words = [CHROMIUM, *FLAGS, f"--user-data-dir={folder}/profile"]
    process = os.posix_spawn(CHROMIUM, words, os.environ, file_actions=actions)
    for end in (*pipes, to_read, to_write):
        os.close(end)
    try:
        yield Tab(send, receive)
    finally:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        os.close(send)
        os.close(receive)
