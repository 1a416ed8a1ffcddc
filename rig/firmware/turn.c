#define _GNU_SOURCE /* semtimedop */
#include "turn.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/sem.h>
#include <time.h>

/* REMOVED: the last program removes the set. MARK: by this value the rig knows a set whose programs were killed. */
enum { TURN, USERS, REMOVED, MARK, SEMAPHORES };
enum { MARK_VALUE = 0x4548 };

static int set = -1; /* of semaphores */

/* CRC-32 as in zlib: the key must be the same in all programs. */
static uint32_t compute_crc(const char *text)
{
    uint32_t crc = UINT32_MAX;
    for (; *text != '\0'; text++) {
        crc ^= (uint8_t)*text;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
    }
    return ~crc;
}

static bool operate(struct sembuf *operations, size_t count, const struct timespec *limit)
{
    int done;
    do
        done = semtimedop(set, operations, count, limit);
    while (done != 0 && errno == EINTR);
    return done == 0;
}

bool turn_join(const char *group, uint16_t port)
{
    struct sembuf join[] = {{REMOVED, 0, IPC_NOWAIT}, {USERS, 1, SEM_UNDO}};
    char name[64];
    snprintf(name, sizeof name, "eha-rig %s %u %d", group, (unsigned)port, SEMAPHORES);
    const key_t key = (key_t)(compute_crc(name) & 0x7FFFFFFF);
    do {
        set = semget(key, SEMAPHORES, IPC_CREAT | 0666);
        if (set < 0)
            return false;
        if (operate(join, 2, NULL)) {
            semctl(set, MARK, SETVAL, MARK_VALUE);
            return true;
        }
    } while (errno == EAGAIN || errno == EIDRM || errno == EINVAL); /* the set is being removed */
    return false;
}

bool turn_take(void)
{
    struct sembuf take[] = {{TURN, 0, 0}, {TURN, 1, SEM_UNDO}};
    const struct timespec limit = {1, 0}; /* a turn takes 20 us */
    return operate(take, 2, &limit);
}

void turn_give(void)
{
    struct sembuf give = {TURN, -1, SEM_UNDO};
    operate(&give, 1, NULL);
}

void turn_leave(void)
{
    struct sembuf leave_last[] = {{USERS, -1, SEM_UNDO}, {USERS, 0, IPC_NOWAIT}, {REMOVED, 1, 0}};
    struct sembuf restore = {REMOVED, -1, IPC_NOWAIT};
    if (!operate(leave_last, 3, NULL))
        operate(leave_last, 1, NULL);
    else if (semctl(set, 0, IPC_RMID) != 0)
        operate(&restore, 1, NULL); /* those of another user stay */
}
