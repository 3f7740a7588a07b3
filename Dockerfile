# docker build -t dpl .
# docker run -it -v dpl:/home/dpl dpl                       # trains the default scene
# docker run -it -v dpl:/home/dpl -p 127.0.0.1:8765:8765 dpl dpl-view run=runs/... host=0.0.0.0
FROM python:3.12-slim
# index of wheels of torch, see "Get started" on pytorch.org; without one they contain CUDA on Linux
ARG TORCH_INDEX=
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY conf conf
COPY dpl dpl
RUN pip install --no-cache-dir ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} -c constraints.txt '.[viewer,onnx]'
RUN useradd --create-home dpl
USER dpl
WORKDIR /home/dpl
CMD ["dpl-train"]
