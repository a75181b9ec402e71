"""Files on the Hugging Face Hub, by `huggingface_hub` (the extra `hub`), which is imported if used.

An address is `hf://USER/REPO`, with a revision after `@` (a branch or tag without a slash, a
commit, or `refs/pr/N`), and the file's path at the end unless it is `proxy.safetensors`:
`hf://USER/REPO@v1/cartpole.safetensors`. Only safetensors files of bounded size are fetched. The
Hub's own cache keeps them, and works without a network.
"""

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

from sejax.options import ConfigError, require, require_package, shortened, told

SCHEME = "hf://"  # addresses on the Hub begin so
FILE = "proxy.safetensors"
MAX_BYTES = 100_000_000  # of a file: a hundred times the largest set of proxies so far

_REPO = r"[\w-][\w.-]*/[\w-][\w.-]*"
_ADDRESS = re.compile(
    rf"{SCHEME}({_REPO})(?:@(refs/pr/\d+|\w[\w.-]*))?"
    r"(?:/((?:\w[\w.-]*/){0,8}\w[\w.-]*\.safetensors))?",
    re.ASCII,
)


def parse(address: str, option: str = "source") -> tuple[str, str | None, str]:
    """Repository, revision (None for the main branch) and file of an address.

    Raises:
      ConfigError: for text that is not an address.

    Example:
      >>> parse("hf://user/repo@v1")
      ('user/repo', 'v1', 'proxy.safetensors')
    """
    match = _ADDRESS.fullmatch(address) if len(address) < 500 else None
    rule = "must be hf://USER/REPO[@REVISION][/FILE.safetensors]"
    if match is None:
        raise ConfigError(option, rule, got=repr(address))
    repo, revision, file = match.groups()
    return repo, revision, file or FILE


def fetch(address: str, option: str = "source") -> Path:
    """The local copy of a file on the Hub, downloaded if there is none or it has changed.

    Args:
      address: of the file.
      option: name of the argument, for messages.

    Raises:
      ConfigError: for text that is not an address, or a file that is not there, is too large or
        cannot be reached; or if `huggingface_hub` is not installed.
    """
    repo, revision, file = parse(address, option)
    with explained(option, address):
        from huggingface_hub import hf_hub_download

        size = hf_hub_download(repo, file, revision=revision, dry_run=True).file_size
        is_small = size is not None and size <= MAX_BYTES
        require(is_small, option, f"must have at most {MAX_BYTES:,} bytes; got {size} there.")
        return Path(hf_hub_download(repo, file, revision=revision))


@contextlib.contextmanager
def explained(option: str, address: str) -> Iterator[None]:
    """Turns whatever `huggingface_hub` raises into one message."""
    require_package(option, "huggingface_hub", "hub")
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:  # the HTTP library's too, which depends on huggingface_hub's version
        got = f"{shortened(address, 60)}: {shortened(told(error), 90)}"
        rule = f"must be within reach on the Hub; got {got}"
        fix = "Check the name and the network, or log in: hf auth login."
        raise ConfigError(option, rule, fix=fix) from error
