"""Files on the Hugging Face Hub, through `huggingface_hub` (the extra `hub`), imported when used.

An address is `hf://USER/REPO`, with a revision (branch, tag or commit) after `@` and the file's
name at the end where it is not `proxy.safetensors`: `hf://USER/REPO@v1/cartpole.safetensors`. What
is fetched is a safetensors file of bounded size, and is kept in the Hub's own cache, from which it
comes when there is no network.
"""

import contextlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sejax.errors import ConfigError, require, shortened, told

SCHEME = "hf://"
FILE = "proxy.safetensors"
MOST_BYTES = 100_000_000  # of a file: a hundred times the largest set of proxies so far

_REPO = r"[\w-][\w.-]*/[\w-][\w.-]*"
_ADDRESS = re.compile(
    rf"{SCHEME}(?P<repo>{_REPO})(@(?P<revision>refs/pr/\d+|\w[\w.-]*))?"
    r"(/(?P<file>(\w[\w.-]*/)*\w[\w.-]*\.safetensors))?",
    re.ASCII,
)


@dataclass(frozen=True)
class Address:
    """A file on the Hub.

    Attributes:
      repo: `USER/REPO`, of models.
      revision: branch, tag or commit; None for the main branch.
      file: its path there.
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
      ConfigError: if it is none.

    Example:
      >>> parse("hf://user/repo@v1")
      Address(repo='user/repo', revision='v1', file='proxy.safetensors')
    """
    found = _ADDRESS.fullmatch(address)
    if found is None:
        raise ConfigError(
            f"{option} must be hf://USER/REPO, hf://USER/REPO@REVISION, or either with "
            f"/FILE.safetensors, because these are what proxies on the Hub are called; got "
            f"{shortened(address)}. Set {option}=hf://USER/REPO."
        )
    return Address(found["repo"], found["revision"], found["file"] or FILE)


def fetch(address: str, option: str = "source") -> Path:
    """The local copy of a file on the Hub, downloaded if there is none or it has changed.

    Args:
      address: of the file.
      option: what messages call it.

    Raises:
      ConfigError: if it is no address, no such file can be seen, it is too large, the Hub cannot be
        reached and no copy is there, or `huggingface_hub` is not installed.
    """
    place = parse(address, option)
    with _explained(option, address):
        from huggingface_hub import hf_hub_download

        info = hf_hub_download(place.repo, place.file, revision=place.revision, dry_run=True)
        size: int | None = info.file_size
        got = f"{'an unknown number of' if size is None else f'{size:,}'} bytes at {address}"
        require(
            size is not None and size <= MOST_BYTES,
            option,
            f"have at most {MOST_BYTES:,} bytes",
            "no proxy is larger",
            got,
            f"{option} to a proxy",
        )
        return Path(hf_hub_download(place.repo, place.file, revision=place.revision))


def upload(repo: str, files: Mapping[str, bytes], message: str, private: bool) -> None:
    """Writes files to a repository in one commit, which is made if it is not there.

    Args:
      repo: `USER/REPO`.
      files: their contents by name.
      message: of the commit.
      private: whether a new repository is.

    Raises:
      ConfigError: if it cannot be written, or `huggingface_hub` is not installed.
    """
    require(
        re.fullmatch(_REPO, repo, re.ASCII),
        "repo",
        "be USER/REPO",
        "that is what the Hub calls repositories",
        repo,
        "repo='USER/REPO'",
    )
    with _explained("repo", repo):
        from huggingface_hub import CommitOperationAdd, HfApi

        api = HfApi()
        api.create_repo(repo, private=private, exist_ok=True)
        additions = [CommitOperationAdd(name, content) for name, content in files.items()]
        api.create_commit(repo, additions, commit_message=message)


@contextlib.contextmanager
def _explained(option: str, place: str) -> Iterator[None]:
    """Makes one message of whatever `huggingface_hub` raises."""
    try:
        yield
    except ConfigError:
        raise
    except ImportError as error:
        raise ConfigError(
            f"{option} must not be on the Hugging Face Hub where huggingface_hub is not installed; "
            f"got {place} ({error}). Install it with pip install 'sejax[hub]'."
        ) from error
    except Exception as error:  # the HTTP library's too, which differs between its versions
        what, fix = _reason(error)
        raise ConfigError(
            f"{option} must be within reach on the Hugging Face Hub; got {place}: {what}. {fix}."
        ) from error


def _reason(error: Any) -> tuple[str, str]:
    """What is wrong, and what to do about it."""
    from huggingface_hub import errors

    if isinstance(error, errors.GatedRepoError):
        return "its owner gives access on request", "Ask on its page, then hf auth login"
    if isinstance(error, errors.RepositoryNotFoundError):
        return (
            "there is no such repository, or it is private",
            "Check its name, or log in with hf auth login",
        )
    if isinstance(error, errors.RevisionNotFoundError):
        return "the repository has no such revision", "Leave it out for the newest"
    if isinstance(error, errors.RemoteEntryNotFoundError):
        return "the repository has no such file", "Name one: hf://USER/REPO/FILE.safetensors"
    if isinstance(error, errors.LocalEntryNotFoundError):
        return (
            "the Hub cannot be reached, and no copy is here",
            "Connect to the network, or load a file",
        )
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403):
        return (
            f"you may not do that (HTTP {status})",
            "Log in with hf auth login and a token that may",
        )
    return told(error), "Try again, or work with a local file"
