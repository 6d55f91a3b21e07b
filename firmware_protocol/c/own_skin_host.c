/* SPDX-License-Identifier: BSD-3-Clause
 *
 * The board of own_skin.c on a computer: its line is a pseudo-terminal, whose name is printed. Channel
 * i reads 10000 + i and, from scan to scan, up to seven counts more.
 *
 *     cc own_skin.c own_skin_host.c -o own_skin
 */
#define _DEFAULT_SOURCE /* cfmakeraw */
#define _XOPEN_SOURCE 600
#include <fcntl.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

size_t board_read(uint8_t *bytes, size_t room);
void board_write(const uint8_t *bytes, size_t n);
uint32_t board_ms(void);
void board_counts(uint16_t *counts, size_t n);

static int line = -1;

static void board_open(void)
{
    struct termios raw;
    const char *name;
    int device;

    line = posix_openpt(O_RDWR | O_NOCTTY);
    if (line < 0 || grantpt(line) != 0 || unlockpt(line) != 0 || !(name = ptsname(line)) ||
        (device = open(name, O_RDWR | O_NOCTTY)) < 0 || tcgetattr(device, &raw) != 0) {
        perror("own_skin");
        exit(1);
    }
    cfmakeraw(&raw); /* no echo before somebody listens; the device stays open, as if plugged in */
    tcsetattr(device, TCSANOW, &raw);
    puts(name);
    fflush(stdout);
}

size_t board_read(uint8_t *bytes, size_t room)
{
    struct pollfd came = {line, POLLIN, 0};
    ssize_t n;

    if (line < 0)
        board_open();
    if (poll(&came, 1, 1) <= 0)
        return 0;
    n = read(line, bytes, room);
    return n > 0 ? (size_t)n : 0;
}

void board_write(const uint8_t *bytes, size_t n)
{
    if (write(line, bytes, n) < 0) /* waits while nobody reads */
        perror("own_skin");
}

uint32_t board_ms(void)
{
    struct timespec now;

    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)now.tv_sec * 1000u + (uint32_t)(now.tv_nsec / 1000000);
}

void board_counts(uint16_t *counts, size_t n)
{
    static unsigned scans;

    scans++;
    for (size_t i = 0; i < n; i++)
        counts[i] = (uint16_t)(10000 + i + scans % 8);
}
