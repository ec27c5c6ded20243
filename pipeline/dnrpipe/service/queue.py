"""The durable queue: jobs and their events in one SQLite file (write-ahead log), used by server and workers alike.

    queued ──claim──► running ──► done | failed | cancelled
       ▲                 │
       └── crash, restart, retry

Each change of state is one transaction, on disk before the call returns: it survives kill -9 and power cuts. Two jobs
of one workspace never run at the same time.
"""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.errors import UserError
from .config import ServerConfig
from .leases import LeaseGone
from .models import FINAL, STATES, End, Job, JobEvent, JobRequest, State
from .root import ServiceRoot, UnknownName

SCHEMA = 3
DAY = 86_400.0
MAX_LOSSES = 6
"""A job fails for good once its worker or server has died this often since it was submitted or retried; stops in order
do not count."""
BATCH = 50
"""Jobs that one transaction prunes; other writers wait for it."""
_TABLES = """
CREATE TABLE IF NOT EXISTS jobs (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    state TEXT NOT NULL,
    workspace TEXT NOT NULL,
    priority INTEGER NOT NULL,
    request TEXT NOT NULL,
    created REAL NOT NULL,
    started REAL,
    finished REAL,
    device TEXT,
    starts INTEGER NOT NULL DEFAULT 0,
    crashes INTEGER NOT NULL DEFAULT 0,
    cancel_requested INTEGER NOT NULL DEFAULT 0,
    exit_code INTEGER,
    error TEXT,
    progress TEXT,
    token TEXT UNIQUE,
    owner TEXT,
    hook_due REAL,
    hook_tries INTEGER NOT NULL DEFAULT 0,
    lost INTEGER NOT NULL DEFAULT 0,
    lease TEXT,
    lease_until REAL,
    lease_beat INTEGER,
    lease_result INTEGER,
    losses INTEGER NOT NULL DEFAULT 0
);
CREATE INDEX IF NOT EXISTS jobs_due ON jobs (state, priority DESC, id);
CREATE TABLE IF NOT EXISTS events (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    job INTEGER NOT NULL REFERENCES jobs (id),
    time REAL NOT NULL,
    kind TEXT NOT NULL,
    data TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS events_of_job ON events (job, id);
CREATE UNIQUE INDEX IF NOT EXISTS jobs_leased ON jobs (lease) WHERE lease IS NOT NULL;
"""
_ADDED = (
    *("owner TEXT", "hook_due REAL", "hook_tries INTEGER NOT NULL DEFAULT 0", "lost INTEGER NOT NULL DEFAULT 0"),
    *("lease TEXT", "lease_until REAL", "lease_beat INTEGER", "lease_result INTEGER"),
    "losses INTEGER NOT NULL DEFAULT 0",
)
"""Columns that queues of before lack."""
_COLUMNS = ", ".join(Job.model_fields)


class QueueFull(UserError):
    """The server accepts no more queued jobs."""


class WrongState(UserError):
    """The job's state does not allow the request."""


class Queue:
    """Jobs in ``path``. Safe in threads and processes; every thread has its own connection.

    Raises UserError: the file is of a newer dnrpipe, or not a queue.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._local = threading.local()
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with self._writing() as db:
                version = db.execute("PRAGMA user_version").fetchone()[0]
                if version > SCHEMA:
                    raise UserError(f"{path}: queue schema {version} is newer than this dnrpipe ({SCHEMA}); upgrade it")
                present = {row["name"] for row in db.execute("PRAGMA table_info(jobs)")}
                for column in _ADDED if present else ():
                    if column.split()[0] not in present:
                        db.execute(f"ALTER TABLE jobs ADD COLUMN {column}")
                for statement in _TABLES.split(";"):
                    db.execute(statement)
                db.execute(f"PRAGMA user_version = {SCHEMA}")
        except sqlite3.DatabaseError as error:
            raise UserError(f"{path}: not a job queue ({error}); move it away to start a new one") from None

    def submit(
        self,
        request: JobRequest,
        *,
        most_queued: int | None = None,
        token: str | None = None,
        owner: str | None = None,
    ) -> Job:
        """Add a job; it is on disk when this returns.

        token: idempotency key. A client that never saw the answer sends its request again with the same key, and
        gets the job that the first request made. Raises QueueFull when `most_queued` jobs wait.
        """
        with self._writing() as db:
            if token is not None:
                found = db.execute(f"SELECT {_COLUMNS} FROM jobs WHERE token = ?", (token,)).fetchone()
                if found is not None:
                    return _job(found)
            if most_queued is not None:
                waiting = db.execute("SELECT count(*) FROM jobs WHERE state = 'queued'").fetchone()[0]
                if waiting >= most_queued:
                    raise QueueFull(f"{waiting} jobs wait already, which is the limit; try again when some are done")
            row = db.execute(
                "INSERT INTO jobs (state, workspace, priority, request, created, token, owner)"
                " VALUES ('queued', ?, ?, ?, ?, ?, ?) RETURNING id",
                (request.workspace, request.priority, request.model_dump_json(), time.time(), token, owner),
            ).fetchone()
            _change(db, row["id"], "queued")
            return self.get(row["id"])

    def get(self, job: int) -> Job:
        """The job. Raises UnknownName."""
        row = self._db().execute(f"SELECT {_COLUMNS} FROM jobs WHERE id = ?", (job,)).fetchone()
        if row is None:
            raise UnknownName(f"there is no job {job}")
        return _job(row)

    def page(
        self,
        *,
        states: Sequence[State] = (),
        workspace: str | None = None,
        search: str = "",
        before: int | None = None,
        limit: int = 100,
    ) -> list[Job]:
        """At most ``limit`` jobs by descending id, below ``before``; with all words of ``search`` in their number,
        workspace, command or owner."""
        where, values = ["1"], []
        if states:
            where.append(f"state IN ({', '.join('?' * len(states))})")
            values += list(states)
        if workspace is not None:
            where.append("workspace = ?")
            values.append(workspace)
        for word in search.split():
            told = "id || ' ' || workspace || ' ' || json_extract(request, '$.command') || ' ' || coalesce(owner, '')"
            where.append(f"instr(lower({told}), ?)")
            values.append(word.lower())
        if before is not None:
            where.append("id < ?")
            values.append(before)
        query = f"SELECT {_COLUMNS} FROM jobs WHERE {' AND '.join(where)} ORDER BY id DESC LIMIT ?"
        return [_job(row) for row in self._db().execute(query, (*values, limit))]

    def owners(self) -> dict[str, str | None]:
        """By workspace: who submitted its first job."""
        found = self._db().execute("SELECT workspace, owner, min(id) FROM jobs GROUP BY workspace").fetchall()
        return {row["workspace"]: row["owner"] for row in found}

    def busy(self, workspace: str) -> bool:
        """Whether a job waits for it or works in it."""
        query = "SELECT 1 FROM jobs WHERE workspace = ? AND state IN ('queued', 'running')"
        return self._db().execute(query, (workspace,)).fetchone() is not None

    def counts(self) -> dict[State, int]:
        found = dict(self._db().execute("SELECT state, count(*) FROM jobs GROUP BY state").fetchall())
        return {state: found.get(state, 0) for state in STATES}

    def claim(self, device: str, *, lease: str | None = None, seconds: float = 0.0) -> Job | None:
        """Take the next job: the highest priority, then the oldest, whose workspace no job is working on.

        lease: of a worker elsewhere; the job is its for ``seconds`` after every sign of life.
        """
        with self._writing() as db:
            row = db.execute(
                "SELECT id, starts FROM jobs WHERE state = 'queued' AND workspace NOT IN"
                " (SELECT workspace FROM jobs WHERE state = 'running') ORDER BY priority DESC, id LIMIT 1"
            ).fetchone()
            if row is None:
                return None
            news = {"device": device, "started": time.time(), "starts": row["starts"] + 1}
            if lease is not None:
                news |= {"lease": lease, "lease_until": time.time() + seconds, "lease_beat": 0, "lease_result": 0}
            _change(db, row["id"], "running", **news, finished=None, exit_code=None, error=None)
            return self.get(row["id"])

    @contextmanager
    def leased(self, lease: str) -> Iterator[Job]:
        """The running job of a lease, which stays so: nobody else writes to the queue meanwhile. Raises LeaseGone."""
        with self._writing() as db:
            row = db.execute(f"SELECT {_COLUMNS} FROM jobs WHERE lease = ?", (lease,)).fetchone()
            if row is None:
                raise LeaseGone("this lease is over; its job ended, or was queued again")
            yield _job(row)

    def extend(self, lease: str, seconds: float) -> Job:
        """A sign of life: the lease lasts ``seconds`` from now. Raises LeaseGone."""
        with self.leased(lease) as job:
            self._db().execute("UPDATE jobs SET lease_until = ? WHERE id = ?", (time.time() + seconds, job.id))
            return job

    def hear(self, job: int, number: int) -> bool:
        """Note a heartbeat of a leased job's worker. Returns whether it was not heard before."""
        with self._writing() as db:
            query = "UPDATE jobs SET lease_beat = ? WHERE id = ? AND lease_beat < ?"
            return db.execute(query, (number, job, number)).rowcount == 1

    def result_came(self, job: int) -> None:
        """What a leased job made is here."""
        with self._writing() as db:
            db.execute("UPDATE jobs SET lease_result = 1 WHERE id = ? AND lease IS NOT NULL", (job,))

    def has_result(self, job: int) -> bool:
        """Whether what a leased job made is here."""
        found = self._db().execute("SELECT 1 FROM jobs WHERE id = ? AND lease_result = 1", (job,))
        return found.fetchone() is not None

    def end(self, job: int, end: End) -> None:
        """Record how a start of a job ended. Does nothing when it is not running any more."""
        if end.state == "queued":
            self.requeue(job, crashed=end.crashed, why=end.error or "")
        else:
            self.finish(job, end.state, exit_code=end.exit_code, error=end.error)

    def finish(self, job: int, state: State, *, exit_code: int | None = None, error: str | None = None) -> None:
        """Record how a running job ended. Does nothing when it is not running any more."""
        assert state in FINAL
        with self._writing() as db:
            if self.get(job).state == "running":
                _change(db, job, state, error, finished=time.time(), exit_code=exit_code, error=error)

    def requeue(self, job: int, *, crashed: bool, why: str) -> None:
        """Queue a running job again; it resumes from its checkpoints when it is claimed."""
        with self._writing() as db:
            found = self.get(job)
            if found.state == "running":
                _change(db, job, "queued", why, crashes=found.crashes + crashed)

    def recover(self, device: str | None = None) -> list[int]:
        """After a crash of server or worker, queue again what was running here (on `device`), or cancel it if that was
        requested. Returns the jobs that were running. Those of workers elsewhere live on."""
        return self._recover("lease IS NULL AND (? IS NULL OR device = ?)", device, device)

    def recover_lapsed(self) -> list[int]:
        """As `recover`, for the jobs of workers elsewhere that gave no sign of life in time."""
        lapsed, now = "lease IS NOT NULL AND lease_until < ?", time.time()
        if self._db().execute(f"SELECT 1 FROM jobs WHERE {lapsed}", (now,)).fetchone() is None:
            return []  # without holding the file for writing
        return self._recover(lapsed, now)

    def _recover(self, which: str, *values: Any) -> list[int]:
        with self._writing() as db:
            rows = db.execute(
                "SELECT id, cancel_requested, losses + 1 AS losses, lost + (lease_result IS 0) AS lost FROM jobs"
                f" WHERE state = 'running' AND {which}",
                values,
            ).fetchall()
            for row in rows:
                if row["cancel_requested"]:
                    state, error = "cancelled", None
                elif row["losses"] >= MAX_LOSSES:
                    state, error = "failed", f"its process was lost {row['losses']} times"
                else:
                    state, error = "queued", None
                finished = None if state == "queued" else time.time()
                why = error or "its worker was lost"
                counts = {"lost": row["lost"], "losses": row["losses"]}
                _change(db, row["id"], state, why, error=error, finished=finished, **counts)
            return [row["id"] for row in rows]

    def cancel(self, job: int) -> Job:
        """Cancel a queued job at once, a running one when its worker sees it. Raises UnknownName, WrongState."""
        with self._writing() as db:
            state = self.get(job).state
            if state in FINAL:
                raise WrongState(f"job {job} is {state}; only queued and running jobs can be cancelled")
            if state == "queued":
                _change(db, job, "cancelled", finished=time.time(), cancel_requested=True)
            else:
                db.execute("UPDATE jobs SET cancel_requested = 1 WHERE id = ?", (job,))
            return self.get(job)

    def retry(self, job: int) -> Job:
        """Queue a failed or cancelled job again; it resumes from what it made. Raises UnknownName, WrongState."""
        with self._writing() as db:
            state = self.get(job).state
            if state not in ("failed", "cancelled"):
                raise WrongState(f"job {job} is {state}; only failed and cancelled jobs can be retried")
            blank = dict.fromkeys(("started", "finished", "exit_code", "error"))
            # Starts stay counted, and so do those of which nothing is left: what the others made is not thrown away.
            _change(db, job, "queued", "retried", cancel_requested=False, crashes=0, losses=0, **blank)
            return self.get(job)

    def due_hooks(self) -> list[tuple[Job, int]]:
        """Ended jobs whose webhook is to be told now, and how often that was tried before."""
        query = f"SELECT {_COLUMNS}, hook_tries FROM jobs WHERE hook_due <= ? ORDER BY hook_due LIMIT 20"
        rows = self._db().execute(query, (time.time(),)).fetchall()
        return [(_job(row), row["hook_tries"]) for row in rows]

    def hook_told(self, job: int, again: float | None) -> None:
        """It was heard, or given up (None); or is to be tried again after so many seconds."""
        due = None if again is None else time.time() + again
        with self._writing() as db:
            db.execute("UPDATE jobs SET hook_due = ?, hook_tries = hook_tries + 1 WHERE id = ?", (due, job))

    def add_events(self, job: int, events: Sequence[dict[str, Any]]) -> None:
        """Store lines of the event stream; the job keeps the last progress, too."""
        if not events:
            return
        with self._writing() as db:
            for event in events:
                facts = {key: value for key, value in event.items() if key not in ("time", "kind")}
                db.execute(
                    "INSERT INTO events (job, time, kind, data) VALUES (?, ?, ?, ?)",
                    (job, float(event["time"]), str(event["kind"]), json.dumps(facts)),
                )
                if event["kind"] == "progress":
                    db.execute("UPDATE jobs SET progress = ? WHERE id = ?", (json.dumps(facts), job))

    def events(self, job: int, after: int = 0) -> list[JobEvent]:
        """The job's events with an id above ``after``, oldest first, 1000 at most."""
        rows = self._db().execute(
            "SELECT id, job, time, kind, data FROM events WHERE job = ? AND id > ? ORDER BY id LIMIT 1000", (job, after)
        )
        return [JobEvent(**dict(row) | {"data": json.loads(row["data"])}) for row in rows]

    def prune(self, root: ServiceRoot, config: ServerConfig, now: float | None = None) -> list[int]:
        """Delete logs and events of jobs that ended more than `config.keep_days` or `config.keep_jobs` jobs ago.

        The jobs and their changes of state stay. Uploads go that no job names which waits, runs or ended later.
        Each batch holds the write lock, so that nobody retries one of its jobs meanwhile. Returns the pruned jobs by
        number.
        """
        before = (time.time() if now is None else now) - config.keep_days * DAY
        folders = (root.log(0).parent, root.events(0).parent)
        has_files = {int(path.stem) for folder in folders for path in folder.iterdir() if path.stem.isdigit()}
        pruned: list[int] = []
        for batch in self._prunable_jobs(before, config.keep_jobs, has_files):
            with self._writing() as db:
                for job in batch:
                    if self.get(job).state in FINAL:  # still
                        db.execute("DELETE FROM events WHERE job = ? AND kind != 'state'", (job,))
                        for path in (root.log(job), root.events(job)):
                            path.unlink(missing_ok=True)
                        pruned.append(job)
        with self._writing() as db:  # nobody submits a job meanwhile
            found = db.execute("SELECT request FROM jobs WHERE finished IS NULL OR finished >= ?", (before,))
            requests = [JobRequest.model_validate_json(row["request"]) for row in found]
            wanted = {request.scene_sha256 for request in requests if request.scene_sha256}
            root.drop_uploads(wanted, (time.time() if now is None else now) - DAY)
        return pruned

    def _prunable_jobs(self, before: float, beyond: int, has_files: Collection[int]) -> list[list[int]]:
        """Ended jobs past the limits that still have events or files, in batches of BATCH."""
        final = ", ".join(f"'{state}'" for state in FINAL)
        rows = self._db().execute(
            "SELECT id, finished, EXISTS (SELECT 1 FROM events WHERE job = jobs.id AND kind != 'state') AS has_events"
            f" FROM jobs WHERE state IN ({final}) ORDER BY finished DESC, id DESC"
        )
        due = [
            row["id"]
            for place, row in enumerate(rows)
            if (row["finished"] < before or place >= beyond) and (row["has_events"] or row["id"] in has_files)
        ]
        return [due[start : start + BATCH] for start in range(0, len(due), BATCH)]

    def last_event(self) -> int:
        return int(self._db().execute("SELECT coalesce(max(id), 0) FROM events").fetchone()[0])

    def close(self) -> None:
        db = getattr(self._local, "db", None)
        if db is not None:
            db.close()
            self._local.db = None

    def _db(self) -> sqlite3.Connection:
        db: sqlite3.Connection | None = getattr(self._local, "db", None)
        if db is None:
            db = sqlite3.connect(self.path, timeout=60.0, isolation_level=None)
            db.row_factory = sqlite3.Row
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            db.execute("PRAGMA foreign_keys = ON")
            self._local.db = db
        return db

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction that holds the file for writing; inside another of this thread, a part of that."""
        db = self._db()
        if db.in_transaction:
            yield db
            return
        db.execute("BEGIN IMMEDIATE")
        try:
            yield db
        except BaseException:
            db.execute("ROLLBACK")
            raise
        db.execute("COMMIT")


def _change(db: sqlite3.Connection, job: int, state: str, why: str | None = None, **columns: Any) -> None:
    """Set a job's state and other columns, and note the state as an event. One that ended is told of (`webhooks`). A
    lease lasts no longer than the state that it came with."""
    columns = {"lease": None, "lease_until": None, "lease_beat": None, "lease_result": None} | columns
    if state in FINAL:
        db.execute(
            "UPDATE jobs SET hook_due = ?, hook_tries = 0"
            " WHERE id = ? AND json_extract(request, '$.webhook') IS NOT NULL",
            (time.time(), job),
        )
    names = ", ".join(f"{name} = ?" for name in ("state", *columns))
    db.execute(f"UPDATE jobs SET {names} WHERE id = ?", (state, *columns.values(), job))
    data = json.dumps({"state": state} | ({"why": why} if why else {}))
    db.execute("INSERT INTO events (job, time, kind, data) VALUES (?, ?, 'state', ?)", (job, time.time(), data))


def _job(row: sqlite3.Row) -> Job:
    known = {key: row[key] for key in Job.model_fields}
    return Job(**known | {key: json.loads(row[key] or "null") for key in ("request", "progress")})
