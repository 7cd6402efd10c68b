"""``python -m phihp_torchrl``: the same as the console command ``phihp``."""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main()
