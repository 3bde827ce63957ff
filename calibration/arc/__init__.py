"""The arc and its metal from frames of the arc's light at known poses."""
