"""A stand-in of the model hub on this machine, which speaks its protocol of files to the real client."""

import base64
import hashlib
import json
import re
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

TOKEN = "hf_stand_in"
NAME = r"(?P<repo>[\w.-]+/[\w.-]+)"


@dataclass
class Repository:
    """Commits of one repository, from the first to the last: their identifiers and files."""

    private: bool = False
    commits: list = field(default_factory=list)

    def commit(self, files):
        identifier = hashlib.sha1(repr((len(self.commits), sorted(files.items()))).encode()).hexdigest()
        self.commits.append((identifier, dict(files)))
        return identifier

    def find(self, revision):
        """Identifier and files of a revision; None without one."""
        if revision == "main":
            return self.commits[-1]
        return next((each for each in self.commits if each[0] == revision), None)


class StandIn:
    """The hub: its repositories, and what it was asked for.

    `large` are the endings of names that go to the store of large files; `told_sizes` replaces sizes in listings.
    """

    def __init__(self, large=()):
        self.large, self.told_sizes = tuple(large), {}
        self.repos, self.objects, self.requests = {}, {}, []
        handler = type("BoundHandler", (Handler,), {"hub": self})
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        self.store_url = f"http://localhost:{self.server.server_port}"  # another host, which must not see tokens
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()

    def add(self, name, files, private=False):
        repo = self.repos.setdefault(name, Repository(private))
        return repo.commit(files)

    def files(self, name):
        return self.repos[name].find("main")[1]

    def fetched(self):
        """Names of the files that were downloaded."""
        return {path.rpartition("/")[2] for method, path in self.requests if method == "GET" and "/resolve/" in path}

    def close(self):
        self.server.shutdown()
        self.server.server_close()


class Handler(BaseHTTPRequestHandler):
    hub: StandIn
    protocol_version = "HTTP/1.1"

    ROUTES = (
        ("POST", r"/api/repos/create", "create"),
        ("POST", r"/api/validate-yaml", "validate"),
        ("GET", rf"/api/models/{NAME}(?:/revision/(?P<revision>.+))?", "describe"),
        ("POST", rf"/api/models/{NAME}/preupload/(?P<revision>[^/]+)", "choose_modes"),
        ("POST", rf"/api/models/{NAME}/commit/(?P<revision>[^/]+)", "commit"),
        ("POST", rf"/{NAME}\.git/info/lfs/objects/batch", "batch"),
        ("PUT", r"/objects/(?P<digest>\w+)", "store"),
        ("GET|HEAD", r"/objects/(?P<digest>\w+)", "load"),
        ("GET|HEAD", rf"/{NAME}/resolve/(?P<revision>[^/]+)/(?P<file>.+)", "resolve"),
    )

    def handle_request(self):
        path = unquote(urlsplit(self.path).path)
        self.hub.requests.append((self.command, path))
        assert not ("/objects/" in path and ".git/" not in path and self.is_user()), "the store was shown the token"
        self.body = self.read_body()
        for methods, pattern, name in self.ROUTES:
            found = re.fullmatch(pattern, path)
            if found and self.command in methods.split("|"):
                return getattr(self, name)(**found.groupdict())
        return self.refuse(404, "NotFound", f"no route {self.command} {path}")

    do_GET = do_HEAD = do_POST = do_PUT = handle_request  # noqa: N815

    def create(self):
        asked = json.loads(self.body)
        name = f"{asked['organization']}/{asked['name']}"
        if not self.is_user():
            return self.refuse(401, "", "Invalid username or password.")
        if name in self.hub.repos:
            return self.answer({"error": "You already created this model repo", "url": f"{self.hub.url}/{name}"}, 409)
        self.hub.add(name, {".gitattributes": b"*.safetensors filter=lfs\n"}, asked.get("visibility") == "private")
        return self.answer({"url": f"{self.hub.url}/{name}"})

    def validate(self):
        text = json.loads(self.body)["content"]
        errors = [] if re.match(r"---\n.*?^license: .*?^---\n", text, re.DOTALL | re.MULTILINE) else ["no metadata"]
        self.answer({"errors": [{"message": each} for each in errors], "warnings": []}, 400 if errors else 200)

    def describe(self, repo, revision):
        found = self.find(repo, revision or "main")
        if found is None:
            return None
        identifier, files = found
        sizes = {name: len(content) for name, content in files.items()} | self.hub.told_sizes
        siblings = [{"rfilename": name, "size": sizes[name]} for name in files]
        if "blobs" not in self.path:
            siblings = [{"rfilename": name} for name in files]
        private = self.hub.repos[repo].private
        return self.answer({"id": repo, "sha": identifier, "private": private, "siblings": siblings})

    def choose_modes(self, repo, revision):
        if self.find(repo, revision, is_write=True) is not None:
            names = [each["path"] for each in json.loads(self.body)["files"]]
            modes = {name: "lfs" if name.endswith(self.hub.large) else "regular" for name in names}
            files = [{"path": name, "uploadMode": modes[name], "shouldIgnore": False} for name in names]
            self.answer({"files": files})

    def commit(self, repo, revision):
        found = self.find(repo, revision, is_write=True)
        if found is None:
            return None
        files = dict(found[1])
        for line in self.body.splitlines():
            entry = json.loads(line)
            value = entry["value"]
            if entry["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                files[value["path"]] = self.hub.objects[value["oid"]]
            elif entry["key"] == "deletedFile":
                del files[value["path"]]
        identifier = self.hub.repos[repo].commit(files)
        url = f"{self.hub.url}/{repo}/commit/{identifier}"
        return self.answer({"success": True, "commitOid": identifier, "commitUrl": url})

    def batch(self, repo):
        objects = []
        for each in json.loads(self.body)["objects"]:
            link = {"href": f"{self.hub.store_url}/objects/{each['oid']}"}
            objects.append({**each, "actions": {"upload": link}} if each["oid"] not in self.hub.objects else each)
        self.answer({"transfer": "basic", "objects": objects})

    def store(self, digest):
        is_right = hashlib.sha256(self.body).hexdigest() == digest
        self.hub.objects[digest] = self.body
        self.answer({}, 200 if is_right else 400)

    def load(self, digest):
        self.send(200, self.hub.objects[digest], {"ETag": f'"{digest}"'})

    def resolve(self, repo, revision, file):
        found = self.find(repo, revision)
        if found is None:
            return None
        identifier, files = found
        if file not in files:
            return self.refuse(404, "EntryNotFound", "Entry not found")
        content, headers = files[file], {"X-Repo-Commit": identifier}
        digest = hashlib.sha256(content).hexdigest()
        if digest in self.hub.objects:
            linked = {"X-Linked-Etag": f'"{digest}"', "X-Linked-Size": str(len(content))}
            return self.send(302, b"", {**headers, **linked, "Location": f"{self.hub.store_url}/objects/{digest}"})
        return self.send(200, content, {**headers, "ETag": f'"{hashlib.sha1(content).hexdigest()}"'})

    def find(self, name, revision, is_write=False):
        """The revision of a repository, or None after the request was refused."""
        repo = self.hub.repos.get(name)
        if repo is None or ((repo.private or is_write) and not self.is_user()):
            return self.refuse(401, "RepoNotFound", "Repository not found")
        found = repo.find(revision)
        return found or self.refuse(404, "RevisionNotFound", f"Invalid rev id: {revision}")

    def is_user(self):
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def refuse(self, status, code, message):
        headers = {"X-Error-Message": message, **({"X-Error-Code": code} if code else {})}
        self.send(status, json.dumps({"error": message}).encode(), headers)

    def answer(self, value, status=200):
        self.send(status, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def send(self, status, content, headers):
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def read_body(self):
        if self.headers.get("Transfer-Encoding") == "chunked":
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def log_message(self, *_):
        pass
