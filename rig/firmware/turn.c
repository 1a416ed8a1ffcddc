#define _GNU_SOURCE /* flock, nanosleep */
#include "turn.h"

#include <fcntl.h>
#include <stdio.h>
#include <sys/file.h>
#include <time.h>
#include <unistd.h>

#include "wait.h"

static const int64_t LIMIT = 1000000000; /* ns; a turn takes 20 us */
static const struct timespec PAUSE = {0, 20000};

static int file = -1; /* whose lock is the turn; the kernel gives back that of a program that ends */

bool turn_join(const char *group, uint16_t port)
{
    char name[64];
    snprintf(name, sizeof name, "/dev/shm/eha-rig-%s-%u", group, (unsigned)port);
    file = open(name, O_RDONLY | O_CLOEXEC); /* to make it again may be refused where another user has it */
    if (file < 0)
        file = open(name, O_RDONLY | O_CLOEXEC | O_CREAT, 0666);
    return file >= 0;
}

bool turn_take(void)
{
    const int64_t give_up = read_clock() + LIMIT;
    while (flock(file, LOCK_EX | LOCK_NB) != 0) {
        if (read_clock() > give_up)
            return false;
        nanosleep(&PAUSE, NULL);
    }
    return true;
}

void turn_give(void)
{
    flock(file, LOCK_UN);
}

void turn_leave(void)
{
    close(file);
}
