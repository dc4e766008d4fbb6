"""Set before torch is imported: its threads wait for one another when tests share the cores."""

import datetime
import os
from pathlib import Path

import pytest
from hypothesis import settings

from mrcdrl.services.tools.certs import HOSTS, ROLES

os.environ.setdefault("OMP_NUM_THREADS", "1")
settings.register_profile("shared cores", deadline=None)  # a wait for a core is no slow example
settings.load_profile("shared cores")


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of an authority and all roles, as `mrcdrl certs` makes it."""
    from mrcdrl.services.tools.certificates import make  # only here is cryptography needed

    folder = tmp_path_factory.mktemp("certificates")
    make(folder, ROLES, HOSTS, datetime.timedelta(days=1))
    return folder
