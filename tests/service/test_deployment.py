"""The examples of a deployment: a unit of systemd, and HTTPS by a proxy in front."""

import os
import shutil
import socket
import ssl
import subprocess
import sys
import time
from importlib import resources
from pathlib import Path

import httpx
import pytest

DEPLOY = Path(str(resources.files("spheremark.service"))) / "deploy"
PATIENCE = 120.0  # [s] ends a test that would hang; one that passes never waits for it
FOR_TESTS = "{\n\tlocal_certs\n\tskip_install_trust\n\tadmin off\n}\n"  # no authority is asked


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def wait_for(url, **options):
    """Wait until something answers."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return httpx.get(url, **options)
        except httpx.HTTPError:
            assert time.monotonic() < deadline
            time.sleep(0.1)


def caddy(folder, upstream, port):
    """Return the command of Caddy, its environment, and the file of its authority."""
    program = shutil.which("caddy") or pytest.skip("caddy is not installed")
    (folder / "Caddyfile").write_text(FOR_TESTS + (DEPLOY / "Caddyfile").read_text())
    environment = {
        "SPHEREMARK_SITE": f"https://localhost:{port}",
        "SPHEREMARK_UPSTREAM": f"127.0.0.1:{upstream}",
        "XDG_DATA_HOME": str(folder / "proxy"),
        "XDG_CONFIG_HOME": str(folder / "proxy"),
    }
    authority = folder / "proxy" / "caddy" / "pki" / "authorities" / "local" / "root.crt"
    command = [program, "run", "--config", folder / "Caddyfile", "--adapter", "caddyfile"]
    return command, environment, authority


def nginx(folder, upstream, port):
    """Return the command of nginx, with a certificate made for the test."""
    program = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin")
    openssl = shutil.which("openssl")
    if not (program and openssl):
        pytest.skip("nginx is not installed")
    certificate, key = folder / "site.pem", folder / "site.key"
    request = [openssl, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"]
    about = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    files = ["-keyout", key, "-out", certificate]
    subprocess.run([*request, *about, *files], check=True, capture_output=True)
    server = (DEPLOY / "nginx.conf").read_text()
    live = "/etc/letsencrypt/live/survey.example"
    for ours, its in (
        ("listen 443 ssl;", f"listen 127.0.0.1:{port} ssl;"),
        ("server_name survey.example;", "server_name localhost;"),
        (f"{live}/fullchain.pem", str(certificate)),
        (f"{live}/privkey.pem", str(key)),
        ("http://127.0.0.1:8000;", f"http://127.0.0.1:{upstream};"),
    ):
        assert server.count(ours) == 1
        server = server.replace(ours, its)
    kept = "".join(
        f"{kind}_temp_path {folder / kind};\n"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    around = f"daemon off; pid {folder / 'pid'}; error_log stderr; events {{}}\n"
    (folder / "nginx.conf").write_text(f"{around}http {{ access_log off;\n{kept}{server}}}\n")
    return [program, "-c", folder / "nginx.conf", "-p", folder], {}, certificate


@pytest.fixture(scope="module", params=[caddy, nginx], ids=lambda one: one.__name__)
def site(tmp_path_factory, request):
    """Return the address of a service behind a proxy, a token, and the proxy's authority."""
    folder = tmp_path_factory.mktemp("deployed")
    upstream, port = free_port(), free_port()
    command_of_proxy, of_proxy, authority = request.param(folder, upstream, port)
    spheremark = [sys.executable, "-m", "spheremark.service.cli"]
    clean = {k: v for k, v in os.environ.items() if not k.startswith("SPHEREMARK_")}
    settings = {
        "SPHEREMARK_DATA": str(folder / "data"),
        "SPHEREMARK_PORT": str(upstream),
        "SPHEREMARK_WORKERS": "1",
    }
    command = [*spheremark, "token", "create", "field", "--scope", "write"]
    made = subprocess.run(
        command, env=clean | settings, check=True, capture_output=True, text=True, timeout=PATIENCE
    )
    token = max(made.stdout.split(), key=len)
    running = [
        subprocess.Popen([*spheremark, "serve"], env=clean | settings),
        subprocess.Popen(command_of_proxy, env=clean | of_proxy, stderr=subprocess.DEVNULL),
    ]
    try:
        wait_for(f"http://127.0.0.1:{upstream}/healthz")
        wait_for(f"https://localhost:{port}/healthz", verify=False)
        yield f"https://localhost:{port}", token, ssl.create_default_context(cafile=authority)
    finally:
        for one in running:
            one.terminate()
            one.wait(PATIENCE)


@pytest.mark.slow
def test_the_service_is_reached_by_https_with_a_token_alone(site):
    address, token, authority = site
    with httpx.Client(base_url=address, verify=authority, timeout=60.0) as client:
        refused = client.get("/api/v1/surveys")
        assert (refused.status_code, refused.json()["code"]) == (401, "unauthorized")
        bearer = {"Authorization": f"Bearer {token}"}
        assert client.get("/api/v1/surveys", headers=bearer).status_code == 200
        made = client.post("/api/v1/surveys", json={"name": "quarry"}, headers=bearer)
        assert made.status_code == 201, made.text
        elsewhere = bearer | {"Origin": "https://elsewhere.example"}
        assert client.post("/api/v1/surveys", json={"name": "b"}, headers=elsewhere).is_client_error


@pytest.mark.slow
def test_a_browser_keeps_a_cookie_that_only_https_carries(site):
    address, token, authority = site
    with httpx.Client(base_url=address, verify=authority, timeout=60.0) as client:
        entered = client.post("/login", data={"token": token}, headers={"Origin": address})
        assert entered.status_code == 303, entered.text
        cookie = entered.headers["set-cookie"]
        assert {"Secure", "HttpOnly", "SameSite=strict"} <= set(cookie.split("; "))
        assert token not in cookie
        assert client.get("/").status_code == 200


@pytest.mark.slow
def test_a_large_log_and_a_live_stream_pass_the_proxy(site):
    address, token, authority = site
    headers = {"Authorization": f"Bearer {token}"}
    with httpx.Client(base_url=address, verify=authority, timeout=60.0, headers=headers) as client:
        chunks = (b"\x89MCAP0\r\n" * 131_072 for _ in range(40))  # 40 MB, of no length beforehand
        answer = client.post(
            "/api/v1/recordings?name=large",
            content=chunks,
            headers={"Content-Type": "application/vnd.mcap"},
        )
        assert answer.status_code == 422, answer.text  # it arrived, and is no log
        assert answer.json()["recording_id"]
        with client.stream("GET", "/api/v1/jobs/events") as events:
            assert events.headers["content-type"].startswith("text/event-stream")


def test_the_unit_is_one_that_systemd_reads(tmp_path):
    verify = shutil.which("systemd-analyze") or pytest.skip("systemd is not installed")
    unit = (DEPLOY / "spheremark.service").read_text()
    here = unit.replace("/opt/spheremark/.venv/bin/spheremark", "/bin/true")
    (tmp_path / "spheremark.service").write_text(here)
    found = subprocess.run(
        [verify, "verify", tmp_path / "spheremark.service"],
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert "spheremark.service:" not in found.stderr
    lines = unit.splitlines()
    assert {"User=spheremark", "UMask=0077", "StateDirectoryMode=0700"} <= set(lines)
    assert (DEPLOY / "spheremark.conf").read_text().splitlines()[1].startswith("u spheremark ")
