# An image for each service: `docker build --target replay .`; `docker compose build` makes all.
# Replay, router, status and web work without PyTorch, and their images are small.
ARG PYTHON=python:3.11-slim-bookworm

# Wheels for pip to prefer, such as another build of PyTorch: `--build-context wheels=FOLDER`.
FROM scratch AS wheels
COPY LICENSE /

# -- packages: the exact versions of constraints.txt, our own package last ---------------------------

FROM ${PYTHON} AS installer
# An additional index, as another source of such a build.
ARG PIP_EXTRA_INDEX_URL
ENV PIP_CONSTRAINT=/src/constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
WORKDIR /src
RUN python -m venv --without-pip /opt/mrcdrl
# What writes an image's bill of materials: CycloneDX, the packages with versions and licences.
ENV SBOM="/opt/sbom/bin/cyclonedx-py environment --output-reproducible --output-file /opt/mrcdrl/sbom.cdx.json /opt/mrcdrl/bin/python"
COPY pyproject.toml constraints.txt README.md LICENSE ./
RUN python -m venv --without-pip /opt/sbom && pip --python /opt/sbom/bin/python install cyclonedx-bom

# Leaves out tests, highlighting of other languages, and byte code that no service reads.
FROM installer AS small-installed
RUN pip --python /opt/mrcdrl/bin/python install --no-compile . \
 && cd /opt/mrcdrl/lib/python3*/site-packages \
 && find . -type d \( -name tests -o -name include -o -path ./numpy/f2py -o -path ./numpy/distutils \) \
      -prune -exec rm -rf {} + \
 && find . -type f \( -name '*.pyi' -o -name '*.a' -o -name '*_tests.*.so' -o -name '_simd.*.so' \) -delete \
 && find pygments/lexers -name '*.py' ! -name '_*.py' ! -name python.py -delete
COPY common common
COPY services services
COPY docs/metrics.md docs/metrics.md
COPY configs configs
COPY mrcdrl mrcdrl
RUN pip --python /opt/mrcdrl/bin/python install --no-compile --no-deps --force-reinstall . \
 && /opt/mrcdrl/bin/python -c "import mrcdrl.cli, mrcdrl.common.runtime.heartbeat, mrcdrl.services.replay.main, \
      mrcdrl.services.replay.inspect.main, mrcdrl.services.router.main, mrcdrl.services.status.main" \
 && $SBOM

FROM small-installed AS web-installed
RUN pip --python /opt/mrcdrl/bin/python install --no-compile starlette uvicorn sse-starlette \
 && /opt/mrcdrl/bin/python -c "import mrcdrl.services.web.main" \
 && $SBOM

FROM small-installed AS certs-installed
RUN pip --python /opt/mrcdrl/bin/python install cryptography \
 && $SBOM

FROM installer AS learning-installed
# Where PyTorch comes from: its own index of builds for CPUs, or with "" pip's index, which also serves
# where that one cannot be reached.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN --mount=type=bind,from=wheels,target=/wheels \
    torch="pip --python /opt/mrcdrl/bin/python install --no-deps --find-links /wheels $(grep '^torch==' constraints.txt)" \
 && { $torch ${TORCH_INDEX:+--index-url $TORCH_INDEX --retries 0 --timeout 5} \
   || { test -n "$TORCH_INDEX" \
     && echo "$TORCH_INDEX has no PyTorch for this machine, or cannot be reached: taking that of pip's index" \
     && $torch; }; }
RUN pip --python /opt/mrcdrl/bin/python install '.[arena,learn]'
COPY common common
COPY services services
COPY configs configs
COPY pretrained pretrained
COPY mrcdrl mrcdrl
RUN pip --python /opt/mrcdrl/bin/python install --no-deps --force-reinstall . \
 && $SBOM

# -- common to all: an unprivileged user, a folder for runs, health by work done ---------------------

FROM ${PYTHON} AS service
# Labels only; `mrcdrl.__version__` is the installed version.
ARG VERSION=unknown
ARG REVISION=unknown
LABEL org.opencontainers.image.title="mrcdrl" \
      org.opencontainers.image.description="Distributed actor-learner for multi-robot coordination" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}"
RUN useradd --uid 10001 --user-group --no-create-home --home-dir /tmp mrcdrl \
 && install --directory --owner=mrcdrl --group=mrcdrl /runs /certs /var/cache/mrcdrl
# PYTHONSAFEPATH: no file of the working directory is imported.
ENV PATH=/opt/mrcdrl/bin:$PATH HOME=/tmp PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 \
    PYTHONSAFEPATH=1 \
    MRCDRL_HEARTBEAT=/tmp/heartbeat
WORKDIR /
USER mrcdrl
ENTRYPOINT ["mrcdrl"]
# Unhealthy after 30 s without work; a main loop that hangs for 120 s is killed and restarted. The start
# period is for replay, which may need it to read a long log; the first check that passes ends it.
HEALTHCHECK --interval=5s --timeout=30s --start-period=600s --retries=2 \
    CMD ["python", "-m", "mrcdrl.common.runtime.heartbeat", "--max-age", "30", "--kill-after", "120"]

FROM service AS small
COPY --from=small-installed /opt/mrcdrl /opt/mrcdrl

FROM service AS learning
COPY --from=learning-installed /opt/mrcdrl /opt/mrcdrl
# Compiled functions are cached here. Freed memory stays with the process, as with `mrcdrl train`.
ENV NUMBA_CACHE_DIR=/var/cache/mrcdrl \
    MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=4294967296 MALLOC_TOP_PAD_=67108864
RUN python -m mrcdrl.services.tools.precompile

# -- one target for each service ----------------------------------------------------------------------

FROM small AS router
CMD ["router", "--help"]

FROM service AS certs
COPY --from=certs-installed /opt/mrcdrl /opt/mrcdrl
CMD ["certs", "--help"]

FROM small AS replay
CMD ["replay", "--help"]

FROM small AS status
CMD ["status", "--help"]

FROM service AS web
COPY --from=web-installed /opt/mrcdrl /opt/mrcdrl
CMD ["web", "--help"]

FROM learning AS actor
CMD ["actor", "--help"]

FROM learning AS evaluator
CMD ["evaluator", "--help"]

FROM learning AS learner
CMD ["learner", "--help"]
