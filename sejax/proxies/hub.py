"""Files on the Hugging Face Hub, by `huggingface_hub` (the extra `hub`), which is imported if used.

An address is `hf://USER/REPO`, with a revision (branch, tag or commit) after `@`, and the file's
path at the end unless it is `proxy.safetensors`: `hf://USER/REPO@v1/cartpole.safetensors`. A file
is fetched if it is a safetensors file of bounded size, and kept in the Hub's own cache, which
serves without a network.
"""

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from sejax.options import ConfigError, require, shortened, told

SCHEME = "hf://"
FILE = "proxy.safetensors"
MAX_BYTES = 100_000_000  # of a file: a hundred times the largest set of proxies so far

_REPO = r"[\w-][\w.-]*/[\w-][\w.-]*"
_ADDRESS = re.compile(
    rf"{SCHEME}(?P<repo>{_REPO})(@(?P<revision>refs/pr/\d+|\w[\w.-]*))?"
    r"(/(?P<file>(\w[\w.-]*/){0,8}\w[\w.-]*\.safetensors))?",
    re.ASCII,
)


class Address(NamedTuple):
    """A file on the Hub.

    Attributes:
      repo: `USER/REPO`, a repository of models.
      revision: branch, tag or commit; None for the main branch.
      file: path of the file there.
    """

    repo: str
    revision: str | None
    file: str


def is_address(source: object) -> bool:
    """Whether a source means the Hub."""
    return str(source).startswith(SCHEME)


def parse(address: str, option: str = "source") -> Address:
    """The parts of an address.

    Raises:
      ConfigError: for text that is not an address.

    Example:
      >>> parse("hf://user/repo@v1")
      Address(repo='user/repo', revision='v1', file='proxy.safetensors')
    """
    found = _ADDRESS.fullmatch(address) if len(address) < 500 else None
    if found is None:
        raise ConfigError(
            f"{option} must be hf://USER/REPO[@REVISION][/FILE.safetensors]; got "
            f"{shortened(address)}.",
            option,
        )
    return Address(found["repo"], found["revision"], found["file"] or FILE)


def fetch(address: str, option: str = "source") -> Path:
    """The local copy of a file on the Hub, downloaded if there is none or it has changed.

    Args:
      address: of the file.
      option: name of the argument, for messages.

    Raises:
      ConfigError: for text that is not an address, or a file that is not there, is too large or
        cannot be reached; or if `huggingface_hub` is not installed.
    """
    place = parse(address, option)
    with _explained(option, address):
        from huggingface_hub import hf_hub_download

        repo, file, revision = place.repo, place.file, place.revision
        found = hf_hub_download(repo, file, revision=revision, dry_run=True)
        size: int | None = found.file_size
        require(
            size is not None and size <= MAX_BYTES,
            option,
            f"must have at most {MAX_BYTES:,} bytes; got {size} bytes at {address}.",
        )
        return Path(hf_hub_download(repo, file, revision=revision))


def require_repo(repo: object) -> None:
    """Checks the name of a repository.

    Raises:
      ConfigError: if it is not `USER/REPO`.
    """
    is_name = isinstance(repo, str) and re.fullmatch(_REPO, repo, re.ASCII)
    require(is_name, "repo", f"must be USER/REPO on the Hub; got {shortened(repo)}.")


def upload(repo: str, files: Mapping[str, bytes], message: str, private: bool) -> None:
    """Writes files to a repository in one commit, and makes the repository if it is not there.

    Args:
      repo: `USER/REPO`.
      files: contents by name.
      message: of the commit.
      private: whether a new repository is private.

    Raises:
      ConfigError: if it cannot be written, or `huggingface_hub` is not installed.
    """
    with _explained("repo", repo):
        from huggingface_hub import CommitOperationAdd, HfApi

        api = HfApi()
        api.create_repo(repo, private=private, exist_ok=True)
        additions = [CommitOperationAdd(name, content) for name, content in files.items()]
        api.create_commit(repo, additions, commit_message=message)


# What to say of an error of `huggingface_hub`, or of the nearest of its base classes.
_REASONS = {
    "GatedRepoError": "its owner gives access on request. Ask there, then hf auth login",
    "RepositoryNotFoundError": "there is no such repository, or it is private. Check its name, or "
    "log in with hf auth login",
    "RevisionNotFoundError": "the repository has no such revision. Leave it out for the newest",
    "RemoteEntryNotFoundError": "the repository has no such file. Name one: "
    "hf://USER/REPO/FILE.safetensors",
    "LocalEntryNotFoundError": "the Hub cannot be reached, and no copy is here. Connect to the "
    "network, or load a file",
}


@contextlib.contextmanager
def _explained(option: str, place: str) -> Iterator[None]:
    """Turns whatever `huggingface_hub` raises into one message."""
    place = shortened(place, 60)
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:  # the HTTP library's too, which differs between its versions
        message = f"{option} must be within reach on the Hub; got {place}: {_reason(error)}."
        raise ConfigError(message, option) from error


def _reason(error: Exception) -> str:
    """What is wrong, and what to do about it."""
    if isinstance(error, ImportError):
        return f"{error}. Install it with pip install 'sejax[hub]'"
    from huggingface_hub.errors import HfHubHTTPError

    for kind in type(error).__mro__:
        if kind.__name__ in _REASONS:
            return _REASONS[kind.__name__]
    status = error.response.status_code if isinstance(error, HfHubHTTPError) else None
    if status in (401, 403):
        return f"you may not do that (HTTP {status}). Log in with hf auth login and a write token"
    return f"{shortened(told(error), 100)}. Try again, or work with a local file"
