"""How many files, and so connections, this process may have open."""

import resource


def allow_open_files(needed: int) -> int:
    """Raise the limit of this process, and of those it starts, as far as the system lets it.

    Returns how many files may then be open, `needed` at most: fewer if the system allows no more.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    return allowed
