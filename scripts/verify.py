"""The mechanics against known answers: python scripts/verify.py writes docs/verification.md."""

if __name__ == "__main__":
    from dpl.commands.verify import main

    main()
