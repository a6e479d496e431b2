# docker build -t icrtool . && docker run --rm -v "$PWD:/logs" icrtool fit field.mcap --robot husky-a200
# --build-arg EXTRAS="cloud" adds optional dependencies (pyproject.toml).
FROM python:3.12-slim AS build
ARG EXTRAS=""
COPY . /icrtool
RUN /icrtool/scripts/container-setup.sh /opt/icrtool $EXTRAS

FROM python:3.12-slim
COPY --from=build /opt/icrtool /opt/icrtool
# As /opt/icrtool/bin/activate sets them. HOME: matplotlib keeps its list of fonts there.
ENV PATH=/opt/icrtool/bin:$PATH NUMBA_CACHE_DIR=/opt/icrtool/kernels NUMBA_CPU_NAME=generic HOME=/tmp
USER 10001:10001
WORKDIR /logs
ENTRYPOINT ["icrtool"]
