/* PLC x gateway x line x cell: the handshake of profile `basic`, with everything that may go wrong a bounded number of
 * times. The gateway's behaviour is not written here: the rows in process `core` are generated from
 * wearline_fieldbus.core.handshake.TABLE. Here stands what its guards and effects mean to the model, and the world.
 *
 * Every step is one atomic guarded command over global variables, so a kill or a cut may fall between any two of them.
 * Time is an order of events: `age` of the cycle in hand is 0 (fresh), 1 (answer_by_s has gone), 2 (no result may be
 * begun any more: silent_after_s - io_timeout_s), 3 (silent_after_s), 4 (minimum_pause_s).
 */

//PARAMETERS

#define CYCLES (PARTS + 2)          /* cycles that the gateway may accept: more than parts, for requests read torn */
#define BIT(n) (1 << (n))

/* A response block is one number. Both halves of it (bits; code and echo) are kept apart, so that a write may be torn. */
#define CLEAR 0
#define READY 1
#define RESULT(number, good) (2 + 2 * (number) + (good))
#define ZERO 200                    /* memory that was never written */
#define NONE 255
#define finished(block) ((block) >= 2 && (block) < ZERO)
#define good(block) (finished(block) && (block) % 2 == 1)
#define echo(block) (((block) - 2) / 2)

/* --- the PLC: its memory, its program --- */
bool q_measure; byte q_number; byte q_life = 1; bool q_object; bool q_camera = true;
byte db_a = ZERO; byte db_b = ZERO;
byte tear_a = NONE; byte tear_b = NONE;     /* halves of a torn write that are still to come */
byte next_number = 1;
mtype = { P_IDLE, P_NUMBERED, P_WAIT, P_DROP, P_DONE };
mtype plc = P_IDLE;

/* --- the truth, which nobody sees --- */
byte part = 1;                              /* the part in the press */
bool is_good;                               /* whether it is good */
bool awaited;                               /* the PLC waits for its result */
byte spent;                                 /* faults so far */
bool calm;                                  /* no fault comes any more */
bool hurt;                                  /* a fault may have touched the trigger that the PLC waits for */
bool stopped; bool changed; bool orphaned; bool no_room;   /* what may rightly end the awaited cycle early */
byte delivered;                             /* the newest cycle whose result has reached the PLC's memory */
byte late = NONE; byte late_cycle;          /* a write that the network keeps back */

/* --- the journal, which survives --- */
byte j[CYCLES + 1];                         /* 0 nothing, 1 accepted, 2 outcome, 3 ended */
byte j_number[CYCLES + 1];
bool j_good;                                /* the newest outcome is Passed */
byte j_newest;                              /* ... and is that of this cycle */
byte count;                                 /* cycles so far: a cycle id is never used twice */

/* --- capture, reconstruct, judge, for the newest cycle and the one before: 1 asked, 2 seen bad, 3 seen good --- */
byte seen_new; byte seen_old; byte asked;
byte odd;                                   /* which mark of a verdict contradicts: 0 none, 1 cycle, 2 number, 3 object */

/* --- the gateway's memory, lost by a kill --- */
//STATES
//EVENTS
byte st;
byte cycle;                                 /* in hand; 0 = none */
byte ruling = NONE;                         /* 0 not passed, 1 passed */
byte age; byte ticked = NONE;
bool was_measure = true; bool rises; bool after_result; bool held; bool restarted;
bool r_measure; byte r_number; byte r_life; bool r_object; bool r_camera;
bool alive = true; bool room = true; bool judge_news; bool room_news;
byte last_number; bool has_edge;
byte shown = NONE; byte acknowledged = NONE;
byte unrecorded;                            /* the cycle of which an entry could not be made; 0 = none */
bool unwritten;                             /* a write that was not done because of it */
byte hit;
mtype = { RECORD_ACCEPTED, RECORD_OUTCOME, PUBLISH_REQUEST, PUBLISH_TOLD, PUBLISH_UNTOLD, WRITE };
chan todo = [6] of { mtype, byte, byte };   /* actions in their order: kind, cycle (0 = none), block or Passed */
chan line = [4] of { byte, byte };          /* writes that wait for their connection: block, cycle (0 = no result) */
/* what the line has seen: event; measure, number, life, object, camera, half a, half b; of a write: block, cycle */
chan inbox = [INBOX] of { byte, bool, byte, byte, bool, bool, byte, byte, byte };
bool core_line;                             /* the connection that the core speaks of */
bool up; bool io_line;                      /* the connection that there is */
byte io_block = NONE; byte io_cycle; bool io_sent; bool io_skip;  /* the exchange under way */
bool news;                                  /* the image is another one than that read last */

#define may_fault (!calm && spent < FAULTS && plc != P_DONE)
#define FAULT spent++; hurt = STRICT
#define is_hurt (hurt || (!STRICT && spent))
#define risky ((KILL || DISK) && may_fault)
#define timing (st == MEASURING || st == TELLING || st == BLIND || st == DOUBTFUL || (!NUMBERED && has_edge && age < 4))
#define ticking (st == MEASURING || st == BLIND || st == DOUBTFUL || st == TOLD || (!NUMBERED && has_edge && age < 5))
#define stale (st == IDLE && ((is_ready && shown != READY) || (!(is_ready) && shown != CLEAR)))  /* the next tick shows it */
#define clock_now (age + 8 * held)
#define tearing (tear_a != NONE || tear_b != NONE)
/* The line is never more than two writes behind when the next event is handled. */
#define ready_for_more (len(todo) == 0 && len(line) < 2 && !unrecorded && !unwritten)
#define roomy (len(inbox) < INBOX)

/* --- what the guards mean --- */
byte e_kind; byte e_a; byte e_b; byte e_cycle; bool e_good;
#define is_auto true
#define no_manual_cycle true
#define plc_is_alive true
#define link_is_ok true
#define object_is_settled true
#define camera_is_on r_camera
#define camera_is_stopped (!r_camera)
#define chain_is_alive alive
#define has_room room
#define measure_is_low (!was_measure || rises)
#define pause_is_over (NUMBERED || !has_edge || age >= 4)
#define measure_rises rises
#define ready_was_shown (acknowledged == READY)
#define number_is_new (!NUMBERED || (r_number != 0 && r_number != last_number))
#define is_numbered NUMBERED
#define plc_restarted restarted
#define response_is_disturbed (acknowledged != NONE && (e_a != acknowledged || e_b != acknowledged))
#define measure_is_the_same (NUMBERED && cycle && r_measure && r_number == j_number[cycle] && !r_object)
#define object_differs (cycle && r_object)
#define result_is_taken (!was_measure && (after_result || held))
#define result_stands (NUMBERED && cycle && ruling != NONE && e_a == e_b && e_a == RESULT(j_number[cycle], ruling))
#define write_is_the_last ((len(line) == 0) && io_block == NONE && (len(todo) == 0))
#define write_is_the_result (e_cycle != 0 && e_cycle == cycle)
#define is_decided (cycle && ruling != NONE)
#define may_still_tell (age < 2)
#define is_in_time (age < 1)
#define answer_is_due (age >= 1)
#define silence_is_due (age >= 3)
#define judge_is_lost (!alive)
#define entry_is_of_cycle (e_cycle != 0 && e_cycle == cycle)
#define verdict_is_of_cycle (cycle && (odd -> odd != 1 : e_cycle == cycle))
#define verdict_is_of_object (cycle && odd != 3)
#define verdict_is_of_number (cycle && (odd -> odd != 2 : j_number[e_cycle] == j_number[cycle]))

//READY

/* --- what the effects mean --- */
inline display(block, of_cycle) {
    if
    :: shown == (block) -> skip
    :: else -> shown = (block); todo!WRITE(of_cycle, shown)
    fi
}
inline clear() { restarted = false; shown = NONE; display(CLEAR, 0) }
inline show_idle() {
    if
    :: st == IDLE && (is_ready) -> cycle = 0; ruling = NONE; display(READY, 0)
    :: st == IDLE && !(is_ready) -> cycle = 0; ruling = NONE; display(CLEAR, 0)
    :: else
    fi
}
inline note_link_lost() { skip }
inline note_disturbed_and_clear() { clear() }
inline accept() {
    assert(count < CYCLES);
    count++; cycle = count; ruling = NONE;
    j_number[cycle] = r_number;
    last_number = r_number; has_edge = true; age = 0; ticked = NONE; held = false;
    todo!RECORD_ACCEPTED(cycle, 0); todo!PUBLISH_REQUEST(cycle, 0);
    display(CLEAR, 0)
}
inline refuse_measure() { rises = false; show_idle() }
inline tell() { display(RESULT(j_number[cycle], ruling), cycle) }
inline decide(passed) { ruling = passed; todo!RECORD_OUTCOME(cycle, ruling); tell() }
inline decide_by_verdict() { decide(e_good) }
inline keep_verdict() { ruling = e_good }
inline clear_and_tell() { clear(); todo!RECORD_OUTCOME(cycle, ruling); tell() }
inline ignore_verdict() { skip }
/* NOT_MEASURED needs a cause; the ghosts know whether there was one. */
inline decide_stopped() { assert(stopped || is_hurt); decide(0) }
inline decide_recipe_changed() { assert(changed || is_hurt); decide(0) }
inline decide_service_lost() { assert(orphaned || is_hurt); decide(0) }
inline decide_late() { assert(age >= 1); decide(0) }
inline decide_disk() { assert(no_room); ruling = 0; tell() }
inline tell_disk() { assert(no_room); shown = NONE; ruling = 0; tell() }
inline confirm_told() { todo!PUBLISH_TOLD(cycle, 0); held = false; ticked = NONE; after_result = was_measure }
inline give_up() {
    assert(is_hurt);
    todo!PUBLISH_UNTOLD(cycle, 0);
    if
    :: st == TOLD -> held = false; ticked = NONE; after_result = was_measure
    :: else -> cycle = 0; ruling = NONE
    fi
}
inline confirm_and_clear() { todo!PUBLISH_TOLD(cycle, 0); cycle = 0; ruling = NONE; clear() }
inline give_up_and_clear() { give_up(); clear() }
inline abandon() { assert(is_hurt); todo!PUBLISH_UNTOLD(cycle, 0); cycle = 0; ruling = NONE }
inline abandon_and_clear() { abandon(); clear() }
inline end_untold() { abandon() }

/* What the machine takes in, whatever its state (Handshake._observe). */
inline take_image(measure, number, life, object, camera) {
    rises = measure && !was_measure;
    was_measure = measure;
    if
    :: measure && st == TOLD -> after_result = true
    :: else
    fi;
    restarted = restarted || (life == 0 && r_life != 0 && e_kind == IMAGE);
    r_measure = measure; r_number = number; r_life = life; r_object = object; r_camera = camera
}
inline forget() {
    if
    :: !ticking -> ticked = NONE; held = false
    :: else
    fi;
    if
    :: NUMBERED && !timing -> age = 0
    :: else
    fi;
    e_kind = 0; e_a = 0; e_b = 0; e_cycle = 0; e_good = false; rises = false; hit = 0; odd = 0;
    x_measure = 0; x_number = 0; x_life = 0; x_object = 0; x_camera = 0
}
inline no_more() {
    do
    :: todo?x_kind,_,_ -> unwritten = unwritten || x_kind == WRITE
    :: len(todo) == 0 -> break
    od
}

/* --- the gateway: one thread handles events, and does what follows from one before it takes the next --- */
byte x_kind; bool x_measure; byte x_number; byte x_life; bool x_object; bool x_camera; byte x_a; byte x_cycle; bool stepping;
active proctype core() {
end:
    do
    :: atomic {
        if
        :: len(todo) == 0 && unrecorded -> e_kind = NOTRECORDED; e_cycle = unrecorded; unrecorded = 0
        :: len(todo) == 0 && !unrecorded && unwritten -> e_kind = SKIPPED; unwritten = false
        :: len(todo) == 0 && len(line) < 3 && !unrecorded && !unwritten && len(inbox) > 0 ->
            inbox?e_kind,x_measure,x_number,x_life,x_object,x_camera,e_a,e_b,e_cycle;
            if
            :: e_kind == LINKED ->
                core_line = !core_line; acknowledged = NONE; restarted = false; was_measure = true;
                last_number = (cycle -> j_number[cycle] : 0);
                take_image(x_measure, x_number, x_life, x_object, x_camera)
            :: e_kind == IMAGE -> take_image(x_measure, x_number, x_life, x_object, x_camera)
            :: e_kind == WRITTEN -> acknowledged = e_a
            :: else
            fi
        :: ready_for_more && seen_new >= 2 ->
            e_kind = VERDICTCAME; e_cycle = asked; e_good = seen_new == 3; seen_new = 0
        :: ready_for_more && seen_old >= 2 ->
            e_kind = VERDICTCAME; e_cycle = asked - 1; e_good = seen_old == 3; seen_old = 0
        :: ready_for_more && MIX && may_fault && cycle && (st == MEASURING || st == BLIND) ->
            FAULT; e_kind = VERDICTCAME; e_cycle = cycle; e_good = true;
            if
            :: odd = 1
            :: odd = 2
            :: odd = 3
            fi
        :: ready_for_more && ((ticked != clock_now && ticking) || stale) -> ticked = clock_now; e_kind = TICK
        :: ready_for_more && judge_news -> judge_news = false; e_kind = SERVICECHANGED
        :: ready_for_more && room_news -> room_news = false; room = true; e_kind = ROOMCHANGED
        :: len(todo) > 0 -> stepping = true
        fi;
        if
        :: e_kind != 0 ->
            hit = 0;
            printf("| gateway: event %d in state %d, cycle %d, age %d\n", e_kind, st, cycle, age);
//TABLE
            printf("|          row %d, state %d\n", hit, st);
            forget()
        :: else
        fi;
        /* One action after the other; where nothing can fall between them, at once. */
        do
        :: len(todo) > 0 && (stepping || !risky) ->
            stepping = false;
            todo?x_kind,x_cycle,x_a; printf("|          does action %d, cycle %d\n", x_kind, x_cycle);
            if
            :: (x_kind == RECORD_ACCEPTED || x_kind == RECORD_OUTCOME) && DISK && may_fault ->
                /* The rest of the actions is not done. */
                FAULT; room = false; no_room = true; no_more(); unrecorded = x_cycle
            :: x_kind == RECORD_ACCEPTED -> assert(j[x_cycle] == 0); j[x_cycle] = 1
            :: x_kind == RECORD_OUTCOME -> assert(j[x_cycle] == 1); j[x_cycle] = 2; j_good = x_a; j_newest = x_cycle
            :: x_kind == PUBLISH_REQUEST -> seen_old = (asked + 1 == x_cycle -> seen_new : 0); seen_new = 1; asked = x_cycle
            :: x_kind == PUBLISH_TOLD ->
                assert(j[x_cycle] == 2 || DISK); assert(delivered == x_cycle); j[x_cycle] = 3
            :: x_kind == PUBLISH_UNTOLD -> assert(j[x_cycle] == 1 || j[x_cycle] == 2 || DISK); j[x_cycle] = 3
            :: x_kind == WRITE && up && core_line == io_line -> assert(len(line) < 4); line!x_a,x_cycle
            :: x_kind == WRITE && !(up && core_line == io_line) -> skip      /* meant for a connection that is no more */
            fi;
            x_kind = 0; x_cycle = 0; x_a = 0
        :: else -> break
        od
       }
    od
}

/* --- the thread of the line, the network and the PLC's communication --- */
inline post(kind, number) { news = false; inbox!kind,q_measure,number,q_life,q_object,q_camera,db_a,db_b,0 }
inline no_exchange() { io_block = NONE; io_cycle = 0; io_sent = false; io_skip = false }
inline no_writes() {
    do
    :: line?_,_
    :: len(line) == 0 -> break
    od
}
inline link_down() { printf("| line: the connection ends\n"); up = false; news = false; no_exchange(); no_writes(); inbox!LINKLOST,0,0,0,0,0,0,0,0 }
inline arrives(block, is_seen) {
    if
    :: db_a = block; db_b = block; news = news || is_seen
    :: TORN && may_fault -> FAULT; db_a = block; tear_b = block; news = true
    :: TORN && may_fault -> FAULT; db_b = block; tear_a = block; news = true
    fi
}
inline deliver() { printf("| line: block %d of cycle %d reaches the PLC\n", io_block, io_cycle);
    /* After silent_after_s nothing is written for that cycle, unless the process was stopped in between. */
    assert(HANG || !io_cycle || io_cycle != cycle || age < 3);
    assert(!io_cycle || io_cycle != delivered);                            /* a result is written once */
    arrives(io_block, io_cycle != 0); io_sent = true;
    if
    :: io_cycle -> delivered = io_cycle
    :: else
    fi
}
active proctype io() {
end:
    do
    :: atomic { !up && roomy -> printf("| line: connects\n"); up = true; io_line = !io_line; post(LINKED, q_number) }
    :: atomic { up && io_block == NONE && roomy && news -> printf("| line: reads measure %d, number %d, block %d/%d\n", q_measure, q_number, db_a, db_b); post(IMAGE, q_number) }
    :: atomic { up && io_block == NONE && roomy && news && TORN && may_fault && q_measure && q_number > 1 ->
        /* the number as it was before, Measure as it is now */
        FAULT; post(IMAGE, q_number - 1); news = true }
    :: atomic { up && io_block == NONE && len(line) > 0 && !tearing ->
        line?io_block,io_cycle;
        if
        :: io_cycle && age >= 2 -> io_skip = true
        :: !(io_cycle && age >= 2) && !HANG -> deliver()
        :: else                             /* a process that is stopped here writes when it goes on */
        fi
       }
    :: atomic { io_block != NONE && !io_sent && !io_skip && !tearing -> deliver() }
    :: atomic { io_skip && roomy -> inbox!SKIPPED,0,0,0,0,0,io_block,io_block,io_cycle; no_exchange() }
    :: atomic { io_sent && !tearing && roomy -> inbox!WRITTEN,0,0,0,0,0,io_block,io_block,io_cycle; no_exchange() }
    :: atomic { up && roomy && CUT && may_fault -> FAULT; link_down() }
    :: atomic { up && roomy && LATE && may_fault && late == NONE && io_block == NONE && len(line) > 0 ->
        /* the network keeps a write back and the connection ends */
        FAULT; line?late,late_cycle; link_down() }
    :: atomic { LATE && may_fault && late == NONE && io_sent -> FAULT; printf("| network: keeps a copy of %d\n", io_block); late = io_block; late_cycle = io_cycle }    /* and a copy comes later */
    :: atomic { late != NONE && !tearing -> printf("| network: the late write %d arrives\n", late); arrives(late, true); hurt = STRICT;
        if
        :: late_cycle > delivered -> delivered = late_cycle
        :: else
        fi;
        late = NONE; late_cycle = 0 }
    :: atomic { tear_a != NONE -> db_a = tear_a; tear_a = NONE; news = true }
    :: atomic { tear_b != NONE -> db_b = tear_b; tear_b = NONE; news = true }
    od
}

/* --- capture, reconstruct and judge see whatever part is in the press when they look --- */
active proctype cell() {
end:
    do
    :: atomic { seen_new == 1 && alive -> printf("| cell: looks at part %d for cycle %d\n", part, asked); seen_new = 2 + is_good }
    :: atomic { seen_old == 1 && alive -> seen_old = 2 + is_good }
    od
}

/* --- time --- */
active proctype clock() {
end:
    do
    :: atomic { timing && age == 0 -> printf("| clock: 2.5 s\n"); age = 1 }
    :: atomic { timing && age == 1 && len(todo) == 0 && (!up || len(line) == 0) && !(st == MEASURING && ticked != clock_now) ->
        age = 2 }
    :: atomic { timing && age == 2 && !io_cycle -> printf("| clock: 3 s\n"); age = 3 }
    :: atomic { !NUMBERED && timing && age == 3 -> age = 4 }
    :: atomic { HANG && may_fault && timing && (age == 1 || age == 2) -> FAULT; age++ }
    :: atomic { st == TOLD && !held && !was_measure && !after_result -> held = true }
    od
}

/* --- the PLC's program: what answers its Measure, it believes; it may lose patience --- */
#define mine (!NUMBERED || echo(db_b) == q_number)
#define answered (finished(db_a) && (finished(db_b) || BLIND_TO_CODE) && mine)
/* On wires half a is Ready and Measure finished, half b is Passed and Failed. */
#define believed ((good(db_a) || WIRES) && (good(db_b) || BLIND_TO_CODE))
#define pause_kept (NUMBERED || !PAUSE || ((!timing || age >= 3) && len(inbox) == 0 && len(todo) == 0))
inline next_part() {
    awaited = false; part++; is_good = false;
    if
    :: part <= PARTS -> is_good = true
    :: skip
    fi
}
active proctype press() {
    if
    :: is_good = true
    :: skip
    fi;
    do
    :: atomic { plc == P_IDLE && !q_life -> q_life = 1; news = true }
    :: atomic { plc == P_IDLE && q_life && part <= PARTS && pause_kept && ((db_a == READY) || HASTY) -> printf("| PLC: sees Ready, writes number %d for part %d\n", next_number, part);
        q_number = (NUMBERED -> next_number : 0); next_number++; plc = P_NUMBERED; news = true }
    :: atomic { plc == P_NUMBERED -> printf("| PLC: raises Measure\n");
        q_measure = true; awaited = true; plc = P_WAIT; news = true;
        stopped = false; changed = false; orphaned = !alive; no_room = !room;
        hurt = (STRICT && !(up && roomy && late == NONE && !tearing && st == IDLE && db_a == READY && acknowledged == READY
            && shown == READY && len(line) == 0 && !restarted && r_life != 0 && alive && !judge_news && room && !room_news))
       }
    :: atomic { plc == P_WAIT && answered -> printf("| PLC: believes block %d/%d of part %d\n", db_a, db_b, part);
        if
        :: believed ->
            assert(is_good);                                               /* never Passed for another part */
            assert(j_good && j_number[j_newest] == q_number)               /* nothing passes that is not on disk */
        :: else
        fi;
        next_part(); plc = P_DROP }
progress_result: skip
    :: atomic { plc == P_WAIT && !STRICT -> printf("| PLC: loses patience\n"); next_part(); plc = P_DROP }
progress_impatience: skip
    :: atomic { plc == P_WAIT && STRICT && timeout -> printf("| PLC: 3 s are over, no result\n");
        assert(hurt);                                                      /* every trigger ends in a result or a fault */
        next_part(); plc = P_DROP }
progress_patience: skip
    :: atomic { plc == P_DROP -> printf("| PLC: drops Measure\n"); q_measure = false; q_object = false; q_camera = true; plc = P_IDLE; news = true }
    :: atomic { plc == P_IDLE && part > PARTS -> plc = P_DONE; break }
    od
}

/* --- what may break, at any moment --- */
inline drain() {
    no_more();
    no_writes();
    do
    :: inbox?_,_,_,_,_,_,_,_,_
    :: len(inbox) == 0 -> break
    od
}
byte i;
inline recover() {
    i = 1;
    do
    :: i > count -> break
    :: i <= count && (j[i] == 0 || j[i] == 3) -> i++
    :: i <= count && j[i] == 1 -> todo!PUBLISH_UNTOLD(i, 0); i++
    :: i <= count && j[i] == 2 ->
        if
        :: i == count && j_number[i] != 0 -> st = DOUBTFUL; cycle = i; ruling = j_good
        :: else -> todo!PUBLISH_UNTOLD(i, 0)
        fi;
        i++
    od;
    i = 0
}
active proctype faults() {
end:
    do
    :: atomic { KILL && may_fault ->
        FAULT; printf("| fault: the gateway is killed\n"); drain();
        st = DOWN; cycle = 0; ruling = NONE; age = 0; ticked = NONE; unrecorded = 0;
        was_measure = true; rises = false; after_result = false; held = false; restarted = false;
        r_measure = 0; r_number = 0; r_life = 0; r_object = 0; r_camera = 0;
        last_number = 0; has_edge = false; shown = NONE; acknowledged = NONE;
        up = false; news = false; core_line = false; io_line = false; no_exchange(); room = true; room_news = false;
        recover()
       }
    :: atomic { PLC_RESTART && may_fault ->
        FAULT; printf("| fault: the PLC restarts\n"); q_measure = false; q_life = 0; q_object = false; q_camera = true; plc = P_IDLE; news = true;
        if
        :: tear_a = NONE; tear_b = NONE; db_a = ZERO; db_b = ZERO
        :: skip
        fi;
        if
        :: FORGETS -> next_number = 1; q_number = 0
        :: else
        fi;
        if
        :: awaited -> next_part()
        :: else
        fi
       }
    :: atomic { CAMERA && may_fault && plc == P_WAIT && q_camera -> FAULT; printf("| fault: camera stopped\n"); q_camera = false; stopped = true; news = true }
    :: atomic { OBJECT && may_fault && plc == P_WAIT && !q_object -> FAULT; printf("| fault: object changed\n"); q_object = true; changed = true; news = true }
    :: atomic { JUDGE && may_fault && alive -> FAULT; printf("| fault: judge goes\n"); alive = false; orphaned = true; judge_news = true }
    :: atomic { !alive && !judge_news -> alive = true; judge_news = true }
    :: atomic { !room && !room_news && !unrecorded -> room_news = true }
    :: atomic { STRICT && !calm -> calm = true }
    od
}

/* --- when all is quiet and the last part is through, nothing is missing and nothing is there twice --- */
active proctype audit() {
    byte c = 1;
end:
    atomic { timeout && plc == P_DONE ->
        do
        :: c <= count -> assert(j[c] == 3 || j[c] == 0); c++
        :: else -> break
        od
    }
}
