# docker build -t gsscale . && docker run --rm -v "$PWD:/data" gsscale train scans/village
#
# Mesa's drivers serve GPUs of AMD and Intel (--device /dev/dri) and the CPU; with NVIDIA's container toolkit, --gpus all serves theirs.
# The page of `gsscale view` needs -p 8080:8080 and --serve 0.0.0.0:8080. COLMAP is not part of the image.
FROM rust:1.95-slim-bookworm AS build
WORKDIR /gsscale
COPY . .
RUN cargo build --release --locked --bin gsscale

FROM debian:bookworm-slim
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends mesa-vulkan-drivers \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /gsscale/target/release/gsscale /gsscale/tools/names/scripts/ /usr/local/bin/
ENV NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility
WORKDIR /data
ENTRYPOINT ["gsscale"]
