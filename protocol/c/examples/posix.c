/* posix.c: a whole drive on a pseudo-terminal, as a firmware would be, for Linux and macOS. Its motor is that of motor.h. In protocol/c:
 *
 *     cc -std=c99 -O2 -DHBP_TX_BYTES=16384 -DHBP_POOL_BYTES=32768 -o drive examples/posix.c hbp.c hbp_capture.c && ./drive
 *
 * It prints a target such as serial:/dev/pts/3. Then, from another terminal: bench info TARGET, bench live TARGET --speed 100,
 * bench hall check TARGET. The queues are larger than a microcontroller's, since other programs may keep this one waiting.
 */
#define _XOPEN_SOURCE 600
#define MOTOR_TICK_HZ 10000000u
#define MOTOR_PWM_HZ 10000u
#define MOTOR_NAME "posix example"

#include "motor.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define AT_A_TIME 20u /* PWM periods between two looks at the link */

static struct hbp_link link_;
static struct hbp drive;

static void must(int good, const char *what)
{
    if (good) return;
    perror(what);
    exit(1);
}

/* A pseudo-terminal that passes every byte on. Its other end stays open here too, so that hosts may come and go. */
static int open_terminal(void)
{
    int port = posix_openpt(O_RDWR | O_NOCTTY), other;
    struct termios raw;
    must(port >= 0 && !grantpt(port) && !unlockpt(port), "pseudo-terminal");
    other = open(ptsname(port), O_RDWR | O_NOCTTY);
    must(other >= 0 && !tcgetattr(other, &raw), ptsname(port));
    raw.c_iflag &= ~(tcflag_t)(BRKINT | ICRNL | IGNCR | INLCR | INPCK | ISTRIP | IXON | IXOFF | PARMRK);
    raw.c_oflag &= ~(tcflag_t)OPOST;
    raw.c_lflag &= ~(tcflag_t)(ECHO | ECHONL | ICANON | IEXTEN | ISIG);
    raw.c_cflag = (raw.c_cflag & ~(tcflag_t)(CSIZE | PARENB)) | CS8;
    raw.c_cc[VMIN] = 1;
    raw.c_cc[VTIME] = 0;
    must(!tcsetattr(other, TCSANOW, &raw) && !fcntl(port, F_SETFL, O_NONBLOCK), ptsname(port));
    return port;
}

static uint64_t nanoseconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

/* The main loop of a firmware: what has come, what time does, what is to go. */
static void serve(int port)
{
    uint8_t received[256];
    const uint8_t *bytes;
    size_t length;
    ssize_t n;
    while ((n = read(port, received, sizeof received)) > 0) hbp_rx(&link_, motor.now, received, (size_t)n);
    do {
        hbp_poll(&link_, motor.now);
        length = hbp_tx_peek(&link_, &bytes);
        n = length ? write(port, bytes, length) : 0;
        if (n > 0) hbp_tx_advance(&link_, (size_t)n);
    } while (n > 0);
    must(n >= 0 || errno == EAGAIN || errno == EINTR, "write");
}

int main(void)
{
    int port = open_terminal();
    struct pollfd wait = {.fd = port, .events = POLLIN};
    uint64_t began = nanoseconds(), periods = 0;
    hbp_link_init(&link_, 0.0f);
    if (hbp_add(&link_, &drive, &motor_config, (uint32_t)(began / 1000u) ^ (uint32_t)getpid())) return 2;
    printf("target: serial:%s\n", ptsname(port));
    fflush(stdout);
    for (;;) {
        uint64_t due = (nanoseconds() - began) / (1000000000u / MOTOR_PWM_HZ);
        for (unsigned k = 0; k < AT_A_TIME && periods < due; k++, periods++) motor_period(&drive); /* "the PWM interrupt" */
        serve(port);
        if (periods >= due) poll(&wait, 1, 1);
    }
}
