//! Durable storage: SQLite tables and the artifact store.
