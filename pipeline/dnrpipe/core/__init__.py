"""What every package knows: settings, the workspace and its files, the ledger, the console. Imports dnrtrain only."""
