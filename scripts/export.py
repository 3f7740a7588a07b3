"""Export a trained surrogate as ONNX, and results for ParaView: python scripts/export.py run=..."""

if __name__ == "__main__":
    from dpl.commands.export import main

    main()
