"""Services of the operating system: files, processes, threads, memory, BLAS."""
