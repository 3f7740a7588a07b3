"""What the package does where it is hard: python scripts/stress.py."""

if __name__ == "__main__":
    from dpl.commands.stress import main

    main()
