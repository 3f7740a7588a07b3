"""What grows, slows down or is left behind: python scripts/soak.py minutes=30; 1 if anything is."""

if __name__ == "__main__":
    from dpl.commands.soak import main

    main()
