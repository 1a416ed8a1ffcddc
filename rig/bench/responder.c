/* Answers each SYNC with feedback and valve state, as fast as a C program can: the measure for the plant emulator.
 *
 *   responder RECEIVE SEND TURN PLACE CPU PRIORITY CYCLE_AT FEEDBACK VALVE_STATE
 *
 * RECEIVE and SEND are open sockets on which only SYNC arrives, TURN and PLACE the file and its byte whose lock is the
 * turn on the UDP bus (udp.py); TURN is -1 on others. The two frames are given in hexadecimal as they go out; CYCLE_AT
 * is the place of the cycle counter in VALVE_STATE.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>

struct frame {
    unsigned char bytes[512];
    size_t size;
};

static struct frame read_frame(const char *text) {
    struct frame frame = {.size = strlen(text) / 2};
    for (size_t i = 0; i < frame.size && i < sizeof frame.bytes; i++) {
        unsigned int byte = 0;
        sscanf(text + 2 * i, "%2x", &byte);
        frame.bytes[i] = (unsigned char)byte;
    }
    return frame;
}

static int turn;
static off_t place;

static int set_lock(short kind) {
    struct flock lock = {.l_type = kind, .l_whence = SEEK_SET, .l_start = place, .l_len = 1};
    return fcntl(turn, F_OFD_SETLKW, &lock);
}

static int send_frame(int socket, const struct frame *frame) {
    if (turn >= 0 && set_lock(F_WRLCK) != 0) return -1;
    ssize_t sent = send(socket, frame->bytes, frame->size, 0);
    if (turn >= 0) set_lock(F_UNLCK);
    return sent < 0 ? -1 : 0;
}

int main(int count, char **words) {
    if (count != 10) return 2;
    int receive = atoi(words[1]), transmit = atoi(words[2]);
    turn = atoi(words[3]);
    place = atoll(words[4]);
    struct sched_param priority = {.sched_priority = atoi(words[6])};
    size_t cycle_at = (size_t)atoi(words[7]);
    struct frame feedback = read_frame(words[8]), valve = read_frame(words[9]);
    cpu_set_t cpus;
    CPU_ZERO(&cpus);
    CPU_SET(atoi(words[5]), &cpus);
    sched_setaffinity(0, sizeof cpus, &cpus);
    sched_setscheduler(0, SCHED_FIFO, &priority); /* without the right to it, as it is: so does the emulator */
    mlockall(MCL_CURRENT | MCL_FUTURE);
    puts("ready");
    fflush(stdout);
    unsigned char sync[512];
    for (unsigned int cycle = 0;; cycle++) {
        while (recv(receive, sync, sizeof sync, 0) < 0)
            if (errno != EAGAIN && errno != EINTR) return 1; /* the sockets have a limit for waiting */
        valve.bytes[cycle_at] = (unsigned char)(cycle & 0xFF);
        valve.bytes[cycle_at + 1] = (unsigned char)(cycle >> 8 & 0xFF);
        if (send_frame(transmit, &feedback) != 0 || send_frame(transmit, &valve) != 0) return 1;
    }
}
