"""A Hugging Face Hub of one process: the few endpoints that `huggingface_hub` uses here."""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

Files = dict[str, bytes]


class FakeHub(ThreadingHTTPServer):
    """Repositories as lists of commits; `url` is what HF_ENDPOINT is set to.

    Attributes:
      commits: of each repository the files after each commit; its last one is the branch `main`.
      refused: HTTP status and error code of all that is asked of a repository.
      claimed_sizes: that files are said to have, by their name.
      private: what repositories were made with.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server_port}"
        self.reset()

    def reset(self) -> None:
        """As if nobody had used it."""
        self.commits: dict[str, list[Files]] = {}
        self.refused: dict[str, tuple[int, str]] = {}
        self.claimed_sizes: dict[str, int] = {}
        self.private: dict[str, bool] = {}


@contextmanager
def serving() -> Iterator[FakeHub]:
    with FakeHub() as hub:
        threading.Thread(target=hub.serve_forever, args=(0.01,), daemon=True).start()
        yield hub
        hub.shutdown()


def oid(repo: str, number: int) -> str:
    """Of a repository's commit."""
    return hashlib.sha1(f"{repo} {number}".encode()).hexdigest()


class Handler(BaseHTTPRequestHandler):
    server: FakeHub
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        """What is at /USER/REPO/resolve/REVISION/FILE; nobody is known by name."""
        if self.path.startswith("/api/"):
            self.answer(401)
            return
        user, name, _, revision, file = self.path[1:].split("/", 4)
        repo = f"{user}/{name}"
        commits = self.server.commits.get(repo, [])
        names = {oid(repo, i): i for i in range(len(commits))} | {"main": len(commits) - 1}
        if repo in self.server.refused:
            status, code = self.server.refused[repo]
            self.answer(status, headers={"X-Error-Code": code})
        elif repo not in self.server.commits:
            self.answer(404, headers={"X-Error-Code": "RepoNotFound"})
        elif revision not in names:
            self.answer(404, headers={"X-Error-Code": "RevisionNotFound"})
        else:
            commit = oid(repo, names[revision])
            content = commits[names[revision]].get(file)
            if content is None:
                self.answer(404, headers={"X-Error-Code": "EntryNotFound", "X-Repo-Commit": commit})
                return
            etag = hashlib.sha1(content).hexdigest()
            self.answer(200, content, {"ETag": f'"{etag}"', "X-Repo-Commit": commit},
                        self.server.claimed_sizes.get(file))  # fmt: skip

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        parts = self.path.partition("?")[0][1:].split("/")
        if self.headers.get("Authorization") != "Bearer hf_secret":
            self.answer(401)
        elif parts == ["api", "repos", "create"]:
            asked = json.loads(body)
            repo = f"{asked['organization']}/{asked['name']}"
            is_new = repo not in self.server.commits
            if is_new:
                self.server.commits[repo] = []
                said = {"visibility": None, "private": False} | asked  # by huggingface_hub 2, or 1
                self.server.private[repo] = said["visibility"] == "private" or said["private"]
            self.answer_json({"url": f"{self.server.url}/{repo}"}, 200 if is_new else 409)
        elif parts[1] == "validate-yaml":
            self.answer_json({"errors": [], "warnings": []})
        elif parts[4] == "preupload":
            names = [file["path"] for file in json.loads(body)["files"]]
            self.answer_json({"files": [{"path": name, "uploadMode": "regular",
                                         "shouldIgnore": False} for name in names]})  # fmt: skip
        elif parts[4] == "commit":
            repo = "/".join(parts[2:4])
            lines = [json.loads(line) for line in body.splitlines()]
            added = {line["value"]["path"]: base64.b64decode(line["value"]["content"])
                     for line in lines if line["key"] == "file"}  # fmt: skip
            commits = self.server.commits[repo]
            commits.append((commits[-1] if commits else {}) | added)
            commit = oid(repo, len(commits) - 1)
            url = f"{self.server.url}/{repo}/commit/{commit}"
            self.answer_json({"commitOid": commit, "commitUrl": url})

    def answer_json(self, values: object, status: int = 200) -> None:
        self.answer(status, json.dumps(values).encode(), {"Content-Type": "application/json"})

    def answer(
        self, status: int, content: bytes = b"", headers: dict[str, str] | None = None,
        claimed_size: int | None = None,
    ) -> None:  # fmt: skip
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(claimed_size or len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def log_message(self, *args: object) -> None:
        """Nothing is printed."""
