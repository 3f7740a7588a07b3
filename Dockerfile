# docker build -t dpl .
# docker run -it -v dpl:/home/dpl dpl                       # trains the default scene
# docker run -it -v dpl:/home/dpl -p 127.0.0.1:8765:8765 dpl dpl-view run=runs/... host=0.0.0.0
FROM python:3.12-slim
# wheels of torch without CUDA; for CUDA use the index of its version
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY conf conf
COPY dpl dpl
RUN pip install --no-cache-dir --extra-index-url "$TORCH_INDEX" -c constraints.txt '.[viewer,onnx]'
RUN useradd --create-home dpl
USER dpl
WORKDIR /home/dpl
CMD ["dpl-train"]
