# mrgs on the CPU, with all extras. Photos and runs come in as a volume:
#   docker build -t mrgs .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" mrgs prepare photos scene
#   docker run --rm -p 127.0.0.1:8080:8080 -v "$PWD:/work" mrgs view runs/scene-mrgs-plus --host 0.0.0.0
FROM python:3.12-slim

# The OpenMP runtime that Numba's threads use, and what WeasyPrint makes PDFs with.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        libgomp1 libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0 \
    && rm -rf /var/lib/apt/lists/*

# The CPU build of torch: the default one brings gigabytes of CUDA libraries.
COPY constraints.txt /src/
RUN pip install --no-cache-dir --constraint /src/constraints.txt torch \
    --index-url https://download.pytorch.org/whl/cpu

COPY pyproject.toml README.md CHANGELOG.md CITATION.cff LICENSE /src/
COPY src /src/src
COPY examples /src/examples
COPY plugins /src/plugins
RUN pip install --no-cache-dir --constraint /src/constraints.txt "/src[all]" /src/plugins/compare \
        /src/plugins/thermonerf

# Compiled kernels are kept below HOME; any user may run the image.
ENV HOME=/tmp

WORKDIR /work
ENTRYPOINT ["mrgs"]
CMD ["--help"]
