"""How reports and figures look: one style for all of them."""
