"""The virtual hub on its wire: frames, faults in them, and the ledger of all that was sent."""
