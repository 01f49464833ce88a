BEGIN TRANSACTION;
CREATE TABLE alembic_version (
	version_num VARCHAR(32) NOT NULL, 
	CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num)
);
INSERT INTO "alembic_version" VALUES('0001');
CREATE TABLE attempts (
	job INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	cores JSON NOT NULL, 
	claimed FLOAT NOT NULL, 
	pid INTEGER, 
	pid_start INTEGER, 
	boot VARCHAR, 
	ended FLOAT, 
	state VARCHAR, 
	message TEXT, 
	core_seconds FLOAT, 
	PRIMARY KEY (job, number), 
	FOREIGN KEY(job) REFERENCES jobs (seq)
);
INSERT INTO "attempts" VALUES(1,1,'[0]',1790000011.0,101,9999,'0c6f...boot',1790000021.0,'error',NULL,6.25);
INSERT INTO "attempts" VALUES(1,2,'[1]',1790000011.0,101,9999,'0c6f...boot',1790000021.0,'succeeded',NULL,6.25);
INSERT INTO "attempts" VALUES(2,1,'[0]',1790000012.0,102,9999,'0c6f...boot',1790000022.0,'failed',NULL,12.5);
INSERT INTO "attempts" VALUES(3,1,'[0]',1790000013.0,103,9999,'0c6f...boot',1790000023.0,'error',NULL,18.75);
INSERT INTO "attempts" VALUES(3,2,'[1]',1790000013.0,103,9999,'0c6f...boot',1790000023.0,'error',NULL,18.75);
INSERT INTO "attempts" VALUES(4,1,'[0]',1790000014.0,104,9999,'0c6f...boot',1790000024.0,'lost',NULL,25.0);
INSERT INTO "attempts" VALUES(5,1,'[0]',1790000015.0,105,9999,'0c6f...boot',1790000025.0,'error',NULL,31.25);
INSERT INTO "attempts" VALUES(5,2,'[1]',1790000015.0,105,9999,'0c6f...boot',1790000025.0,'cancelled',NULL,31.25);
INSERT INTO "attempts" VALUES(6,1,'[0]',1790000016.0,106,9999,'0c6f...boot',1790000026.0,'timed_out',NULL,37.5);
INSERT INTO "attempts" VALUES(8,1,'[0]',1790000018.0,NULL,NULL,NULL,NULL,NULL,NULL,NULL);
INSERT INTO "attempts" VALUES(9,1,'[0]',1790000019.0,109,9999,'0c6f...boot',1790000029.0,'error',NULL,56.25);
INSERT INTO "attempts" VALUES(9,2,'[1]',1790000019.0,109,9999,'0c6f...boot',NULL,NULL,NULL,NULL);
CREATE TABLE events (
	seq INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	job INTEGER NOT NULL, 
	at FLOAT NOT NULL, 
	state VARCHAR NOT NULL, 
	message TEXT, 
	FOREIGN KEY(job) REFERENCES jobs (seq)
);
INSERT INTO "events" VALUES(1,1,1790000001.0,'queued',NULL);
INSERT INTO "events" VALUES(2,1,1790000002.0,'starting',NULL);
INSERT INTO "events" VALUES(3,1,1790000003.0,'running',NULL);
INSERT INTO "events" VALUES(4,1,1790000004.0,'succeeded',NULL);
INSERT INTO "events" VALUES(5,2,1790000002.0,'queued',NULL);
INSERT INTO "events" VALUES(6,2,1790000003.0,'starting',NULL);
INSERT INTO "events" VALUES(7,2,1790000004.0,'running',NULL);
INSERT INTO "events" VALUES(8,2,1790000005.0,'failed',NULL);
INSERT INTO "events" VALUES(9,3,1790000003.0,'queued',NULL);
INSERT INTO "events" VALUES(10,3,1790000004.0,'starting',NULL);
INSERT INTO "events" VALUES(11,3,1790000005.0,'running',NULL);
INSERT INTO "events" VALUES(12,3,1790000006.0,'error',NULL);
INSERT INTO "events" VALUES(13,4,1790000004.0,'queued',NULL);
INSERT INTO "events" VALUES(14,4,1790000005.0,'starting',NULL);
INSERT INTO "events" VALUES(15,4,1790000006.0,'running',NULL);
INSERT INTO "events" VALUES(16,4,1790000007.0,'lost',NULL);
INSERT INTO "events" VALUES(17,5,1790000005.0,'queued',NULL);
INSERT INTO "events" VALUES(18,5,1790000006.0,'starting',NULL);
INSERT INTO "events" VALUES(19,5,1790000007.0,'running',NULL);
INSERT INTO "events" VALUES(20,5,1790000008.0,'cancelled',NULL);
INSERT INTO "events" VALUES(21,6,1790000006.0,'queued',NULL);
INSERT INTO "events" VALUES(22,6,1790000007.0,'starting',NULL);
INSERT INTO "events" VALUES(23,6,1790000008.0,'running',NULL);
INSERT INTO "events" VALUES(24,6,1790000009.0,'timed_out',NULL);
INSERT INTO "events" VALUES(25,7,1790000007.0,'queued',NULL);
INSERT INTO "events" VALUES(26,8,1790000008.0,'queued',NULL);
INSERT INTO "events" VALUES(27,8,1790000009.0,'starting',NULL);
INSERT INTO "events" VALUES(28,9,1790000009.0,'queued',NULL);
INSERT INTO "events" VALUES(29,9,1790000010.0,'starting',NULL);
INSERT INTO "events" VALUES(30,9,1790000011.0,'running',NULL);
CREATE TABLE history (
	job INTEGER NOT NULL, 
	"row" INTEGER NOT NULL, 
	time FLOAT NOT NULL, 
	vacancy_ratio FLOAT, 
	data TEXT NOT NULL, 
	PRIMARY KEY (job, "row"), 
	FOREIGN KEY(job) REFERENCES jobs (seq)
);
INSERT INTO "history" VALUES(1,0,0.0,0.5,'{"time": 0.0, "vacancy_ratio": 0.5, "step": 0}');
INSERT INTO "history" VALUES(1,1,0.1,0.49,'{"time": 0.1, "vacancy_ratio": 0.49, "step": 7}');
INSERT INTO "history" VALUES(1,2,0.2,0.48,'{"time": 0.2, "vacancy_ratio": 0.48, "step": 14}');
INSERT INTO "history" VALUES(1,3,0.3,0.47,'{"time": 0.3, "vacancy_ratio": 0.47, "step": 21}');
INSERT INTO "history" VALUES(9,0,0.0,NULL,'{"time":0.0,"vacancy_ratio":null,"step":0}');
CREATE TABLE idempotency (
	"key" VARCHAR NOT NULL, 
	fingerprint VARCHAR NOT NULL, 
	resource VARCHAR NOT NULL, 
	created FLOAT NOT NULL, 
	PRIMARY KEY ("key")
);
INSERT INTO "idempotency" VALUES('me POST /v1/jobs k1','ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff','0101010101010101',1790000000.0);
CREATE TABLE jobs (
	seq INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	id VARCHAR NOT NULL, 
	name TEXT NOT NULL, 
	identity VARCHAR NOT NULL, 
	state VARCHAR NOT NULL, 
	message TEXT, 
	priority INTEGER NOT NULL, 
	ranks INTEGER NOT NULL, 
	tags JSON NOT NULL, 
	time_limit FLOAT, 
	attempt INTEGER NOT NULL, 
	failures INTEGER NOT NULL, 
	retrying BOOLEAN NOT NULL, 
	stopping BOOLEAN NOT NULL, 
	created FLOAT NOT NULL, 
	started FLOAT, 
	ended FLOAT, 
	core_seconds FLOAT, 
	result JSON NOT NULL, 
	"case" TEXT NOT NULL, 
	CONSTRAINT uq_jobs_id UNIQUE (id)
);
INSERT INTO "jobs" VALUES(1,'0101010101010101','job 1','0101010101010101010101010101010101010101010101010101010101010101','succeeded',NULL,0,2,'["a", "b"]',NULL,2,0,0,0,1790000001.0,1790000011.0,1790000021.0,12.5,'{"time": 10.0, "vacancy_ratio": 0.25}','{"name":"r 5.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":5.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(2,'0202020202020202','job 2','0202020202020202020202020202020202020202020202020202020202020202','failed','why 2',1,1,'[]',NULL,1,0,0,0,1790000002.0,1790000012.0,1790000022.0,25.0,'{}','{"name":"r 6.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":6.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(3,'0303030303030303','job 3','0303030303030303030303030303030303030303030303030303030303030303','error','why 3',-1,2,'["a", "b"]',NULL,2,1,1,0,1790000003.0,1790000013.0,1790000023.0,37.5,'{}','{"name":"r 7.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":7.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(4,'0404040404040404','job 4','0404040404040404040404040404040404040404040404040404040404040404','lost','why 4',0,1,'[]',NULL,1,1,0,0,1790000004.0,1790000014.0,1790000024.0,50.0,'{}','{"name":"r 8.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":8.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(5,'0505050505050505','job 5','0505050505050505050505050505050505050505050505050505050505050505','cancelled','why 5',1,2,'["a", "b"]',NULL,2,0,0,0,1790000005.0,1790000015.0,1790000025.0,62.5,'{}','{"name":"r 9.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":9.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(6,'0606060606060606','job 6','0606060606060606060606060606060606060606060606060606060606060606','timed_out','why 6',-1,1,'[]',3600.0,1,0,0,0,1790000006.0,1790000016.0,1790000026.0,75.0,'{}','{"name":"r 10.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":10.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(7,'0707070707070707','job 7','0707070707070707070707070707070707070707070707070707070707070707','queued',NULL,0,2,'["a", "b"]',NULL,0,0,0,0,1790000007.0,NULL,NULL,NULL,'{}','{"name":"r 11.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":11.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(8,'0808080808080808','job 8','0808080808080808080808080808080808080808080808080808080808080808','starting',NULL,1,1,'[]',NULL,1,0,0,0,1790000008.0,1790000018.0,NULL,NULL,'{}','{"name":"r 12.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":12.0,"std_radius":1.0,"packing_density":0.5}}');
INSERT INTO "jobs" VALUES(9,'0909090909090909','job 9','0909090909090909090909090909090909090909090909090909090909090909','running',NULL,-1,2,'["a", "b"]',NULL,2,0,0,1,1790000009.0,1790000019.0,NULL,NULL,'{}','{"name":"r 13.0","domain":{"size":[22.0,13.0]},"particles":{"source":"packing","mean_radius":13.0,"std_radius":1.0,"packing_density":0.5}}');
CREATE TABLE snapshots (
	job INTEGER NOT NULL, 
	number INTEGER NOT NULL, 
	time FLOAT NOT NULL, 
	PRIMARY KEY (job, number), 
	FOREIGN KEY(job) REFERENCES jobs (seq)
);
INSERT INTO "snapshots" VALUES(1,0,0.0);
INSERT INTO "snapshots" VALUES(1,1,0.3);
INSERT INTO "snapshots" VALUES(9,0,0.0);
CREATE TABLE sweep_jobs (
	sweep INTEGER NOT NULL, 
	position INTEGER NOT NULL, 
	job INTEGER NOT NULL, 
	name TEXT NOT NULL, 
	parameters JSON NOT NULL, 
	PRIMARY KEY (sweep, position), 
	FOREIGN KEY(sweep) REFERENCES sweeps (seq), 
	FOREIGN KEY(job) REFERENCES jobs (seq)
);
INSERT INTO "sweep_jobs" VALUES(1,0,1,'r 5','{"particles.mean_radius":5.0}');
INSERT INTO "sweep_jobs" VALUES(1,1,2,'r 6','{"particles.mean_radius":6.0}');
INSERT INTO "sweep_jobs" VALUES(1,2,7,'r 11','{"particles.mean_radius":11.0}');
INSERT INTO "sweep_jobs" VALUES(2,0,1,'r 5','{}');
CREATE TABLE sweeps (
	seq INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT, 
	id VARCHAR NOT NULL, 
	name TEXT NOT NULL, 
	definition TEXT NOT NULL, 
	created FLOAT NOT NULL, 
	CONSTRAINT uq_sweeps_id UNIQUE (id)
);
INSERT INTO "sweeps" VALUES(1,'s1','density by spread','{"name":"density by spread"}',1790000000.0);
INSERT INTO "sweeps" VALUES(2,'s2','more','{"name":"more"}',1790000050.0);
CREATE TABLE tokens (
	seq INTEGER NOT NULL, 
	name TEXT NOT NULL, 
	hash VARCHAR NOT NULL, 
	scope VARCHAR NOT NULL, 
	created FLOAT NOT NULL, 
	revoked FLOAT, 
	PRIMARY KEY (seq), 
	CONSTRAINT uq_tokens_name UNIQUE (name), 
	CONSTRAINT uq_tokens_hash UNIQUE (hash)
);
INSERT INTO "tokens" VALUES(1,'ci','abababababababababababababababababababababababababababababababab','submit',1790000000.0,NULL);
INSERT INTO "tokens" VALUES(2,'old','cdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcdcd','admin',1790000000.0,1790000001.0);
CREATE INDEX ix_jobs_identity ON jobs (identity);
CREATE INDEX ix_jobs_queue ON jobs (state, priority DESC, seq);
CREATE INDEX ix_jobs_state_seq ON jobs (state, seq);
CREATE INDEX ix_sweep_jobs_job ON sweep_jobs (job);
CREATE INDEX ix_events_job_seq ON events (job, seq);
DELETE FROM "sqlite_sequence";
INSERT INTO "sqlite_sequence" VALUES('sweeps',2);
INSERT INTO "sqlite_sequence" VALUES('jobs',9);
INSERT INTO "sqlite_sequence" VALUES('events',30);
COMMIT;
