"""Names of hosts, as HTTP has them."""


def host_of(header: str) -> str:
    """The name in a Host header, without its port, in lower case."""
    name, _, port = header.rpartition(":")
    return (name if name and port.isdigit() else header).lower()


def in_url(host: str) -> str:
    """The host as it stands in a URL: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host
