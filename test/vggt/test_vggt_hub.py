# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Location of weights: files, and repositories of a simulated Hugging Face hub."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import vggt_models  # noqa: F401  (skips where the client is missing)
from command_lines import ENVIRONMENT, run_python

from kfvo_ros.backbones.vggt.checkpoint import locate_weights
from kfvo_ros.errors import KfvoError

VGGT, COMMERCIAL = 'facebook/VGGT-1B', 'facebook/VGGT-1B-Commercial'
COMMIT, CONTENT = '0123456789abcdef' * 2 + '01234567', b'weights' * 1000
LOCATE = """
import sys
from kfvo_ros.backbones.vggt.checkpoint import locate_weights
from kfvo_ros.errors import KfvoError
try:
    for revision in sys.argv[2:] or [None]:
        print(locate_weights(sys.argv[1], revision))
except KfvoError as error:
    sys.exit(f'error: {error}')
"""
"""Runs in its own process: the hub's client reads its settings once."""


class Hub(BaseHTTPRequestHandler):
    """Responds like huggingface.co, with one public and one gated repository."""

    requests: list[str] = []

    def do_HEAD(self) -> None:
        self.requests.append(f'{self.command} {self.path}')
        if self.path.startswith(f'/{COMMERCIAL}/'):
            return self._answer(403, {'X-Error-Code': 'GatedRepo',
                                      'X-Error-Message': 'Access is restricted.'})
        if not self.path.startswith(f'/{VGGT}/'):
            return self._answer(404, {'X-Error-Code': 'RepoNotFound'})
        if self.path not in (f'/{VGGT}/resolve/{revision}/model.safetensors'
                             for revision in ('main', 'v1', COMMIT)):
            return self._answer(404, {'X-Error-Code': 'RevisionNotFound'})
        return self._answer(200, {'ETag': '"abc"', 'X-Repo-Commit': COMMIT}, CONTENT)

    def do_GET(self) -> None:
        self.do_HEAD()

    def _answer(self, status: int, headers: dict[str, str], content: bytes = b'') -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header('Content-Length', str(len(content)))
        self.end_headers()
        if self.command == 'GET':
            self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@pytest.fixture(scope='module')
def hub() -> Iterator[str]:
    """Address of a running hub."""
    with ThreadingHTTPServer(('127.0.0.1', 0), Hub) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f'http://127.0.0.1:{server.server_port}'
        server.shutdown()
        thread.join()


def locate(home: Path, repository: str, *revisions: str, endpoint: str | None = None
             ) -> subprocess.CompletedProcess[str]:
    """Locate weights with the cache `home`, from the hub `endpoint` or offline."""
    settings = {'HF_HOME': str(home), 'NO_PROXY': '127.0.0.1', 'HF_HUB_DISABLE_XET': '1'}
    settings |= {'HF_ENDPOINT': endpoint} if endpoint else {'HF_HUB_OFFLINE': '1'}
    return run_python('-c', LOCATE, repository, *revisions, env=ENVIRONMENT | settings)


def error_line(done: subprocess.CompletedProcess[str]) -> str:
    """Return the only error line of a failed process."""
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    line, = (line for line in done.stderr.splitlines() if line.startswith('error: '))
    return line


def test_a_repository_is_downloaded_once_and_then_found_offline(hub, tmp_path):
    Hub.requests.clear()
    done = locate(tmp_path, VGGT, endpoint=hub)
    assert done.returncode == 0, done.stderr
    path = Path(done.stdout.strip())
    assert path.name == 'model.safetensors' and tmp_path in path.parents
    assert path.read_bytes() == CONTENT
    count = len(Hub.requests)
    assert count >= 1
    assert locate(tmp_path, VGGT, endpoint=hub).stdout == done.stdout
    assert len(Hub.requests) == count  # the cache needs no hub
    assert locate(tmp_path, VGGT, 'main', COMMIT).stdout == 2 * done.stdout
    assert 'not on this machine' in error_line(locate(tmp_path, VGGT, 'v1'))
    assert locate(tmp_path, VGGT, 'v1', endpoint=hub).stdout == done.stdout
    assert any('/resolve/v1/' in request for request in Hub.requests)


@pytest.mark.parametrize(('repository', 'name'), [
    (VGGT, 'model.safetensors'), (COMMERCIAL, 'vggt_1B_commercial.pt')])
def test_a_copied_cache_is_found(repository, name, tmp_path):
    folder = tmp_path / 'hub' / f'models--{repository.replace("/", "--")}'
    path = folder / 'snapshots' / COMMIT / name
    path.parent.mkdir(parents=True)
    path.write_bytes(CONTENT)
    (folder / 'refs').mkdir()
    (folder / 'refs' / 'main').write_text(COMMIT)
    done = locate(tmp_path, repository, 'main', COMMIT)
    assert done.stdout.splitlines() == [str(path)] * 2, done.stderr


def test_without_network_and_cache_the_error_names_three_remedies(tmp_path):
    line = error_line(locate(tmp_path, VGGT))
    assert all(way in line for way in (
        VGGT, 'connect it to the network', 'copy model.safetensors from https://huggingface.co/',
        'set weights to its path', 'geometric backbone'))


def test_the_error_of_a_gated_repository_explains_access(hub, tmp_path):
    line = error_line(locate(tmp_path, COMMERCIAL, endpoint=hub))
    assert all(part in line for part in (
        COMMERCIAL, 'granted on request', f'https://huggingface.co/{COMMERCIAL}',
        'hf auth login'))


@pytest.mark.parametrize('arguments', [['someone/else'], [VGGT, 'no-such-branch']])
def test_repositories_and_revisions_unknown_to_the_hub(arguments, hub, tmp_path):
    line = error_line(locate(tmp_path, *arguments, endpoint=hub))
    assert all(part in line for part in ('cannot download model.safetensors', *arguments))


@pytest.mark.parametrize('weights', [
    'VGGT', 'a/b/c', 'https://huggingface.co/facebook/VGGT-1B', 'a b/c', '', 'a' * 300])
def test_invalid_repository_names(weights):
    with pytest.raises(KfvoError, match='weights'):
        locate_weights(weights)


@pytest.mark.parametrize('weights', ['../VGGT', 'a/b..c', 'a/-b', f'a/{"b" * 200}'])
def test_repository_names_refused_by_the_hub(weights):
    with pytest.raises(KfvoError, match=f'cannot download .* of {weights}'):
        locate_weights(weights)


@pytest.mark.parametrize('weights', [
    '/no/such/file.pt', 'no.safetensors', '~no-such-user/file.pth', f'{"a" * 300}.pt'])
def test_missing_files(weights):
    with pytest.raises(KfvoError, match='there is no file of weights'):
        locate_weights(weights)


def test_existing_files_are_found(tmp_path, monkeypatch):
    file = tmp_path / 'weights'
    file.write_bytes(CONTENT)
    assert locate_weights(str(file)) == file
    monkeypatch.setenv('HOME', str(tmp_path))
    assert locate_weights('~/weights') == file
    with pytest.raises(KfvoError, match='there is no file'):
        locate_weights(str(tmp_path))
