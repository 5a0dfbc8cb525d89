"""The command that installs an extra, in the form that fits how this package was installed."""

import json
from importlib.metadata import distributions
from shlex import quote
from urllib.parse import urlsplit
from urllib.request import url2pathname

__all__ = ["install_command"]


def install_command(extra: str) -> str:
    """Return the pip command for an extra: with the path of the checkout or wheel, by name only from an index."""
    found = [one for name in ("optipmb", "optipmb-node") for one in distributions(name=name)]
    name = found[0].name if found else "optipmb"
    # After an installation from an index there is no such file.
    origin = json.loads((found[0].read_text("direct_url.json") if found else None) or "{}")
    url, editable = origin.get("url", ""), origin.get("dir_info", {}).get("editable")
    if url.startswith("file:") and "vcs_info" not in origin:
        return f"pip install {'-e ' if editable else ''}{quote(f'{url2pathname(urlsplit(url).path)}[{extra}]')}"
    scheme = f"{origin['vcs_info']['vcs']}+" if "vcs_info" in origin else ""
    return f"pip install {quote(f'{name}[{extra}]' + (f' @ {scheme}{url}' if url else ''))}"
