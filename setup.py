"""What the package page says: the README, with addresses that work there.

A package page has no files of the repository beside it. So pictures and links of the README get
their address in the public repository that the package is built from. Without one they stay.
"""

from __future__ import annotations

import re
import subprocess
from email import message_from_string
from pathlib import Path

HERE = Path(__file__).parent


def public_address(remote: str) -> str | None:
    """The address on the web of a repository, by that of git, over HTTPS or SSH."""
    found = re.fullmatch(
        r"(?:https://(?:[^@/]+@)?|ssh://git@|git@)([\w-]+(?:\.[\w-]+)+)[:/](.+?)(?:\.git)?/?",
        remote,
    )
    return f"https://{found[1]}/{found[2]}" if found else None


def with_addresses(readme: str, repository: str) -> str:
    """The README with full addresses of its pictures (``![…](…)``) and links (``[…](…)``)."""

    def full(found: re.Match) -> str:
        picture, text, place = found.groups()
        return f"{picture}[{text}]({repository}/{'raw' if picture else 'blob'}/HEAD/{place})"

    return re.sub(r"(!?)\[([^]]*)\]\((?!\w+:)([^)]+)\)", full, readme)


def description() -> str:
    """The text of the package page."""
    made_before = HERE / "PKG-INFO"
    if made_before.exists():  # a source distribution, which knows no repository
        return str(message_from_string(made_before.read_text(encoding="utf-8")).get_payload())
    readme = (HERE / "README.md").read_text(encoding="utf-8")
    git = ["git", f"--git-dir={HERE / '.git'}", "config", "--get", "remote.origin.url"]
    try:
        remote = subprocess.run(git, capture_output=True, text=True, check=False).stdout
    except OSError:  # no git
        return readme
    repository = public_address(remote.strip())
    return readme if repository is None else with_addresses(readme, repository)


if __name__ == "__main__":
    from setuptools import setup

    setup(long_description=description(), long_description_content_type="text/markdown")
