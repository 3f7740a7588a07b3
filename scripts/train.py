"""Train and evaluate a surrogate: python scripts/train.py model=fcnn loss=lr_star."""

if __name__ == "__main__":
    from dpl.commands.train import main

    main()
